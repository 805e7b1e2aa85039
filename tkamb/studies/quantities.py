"""The quantities by which two contact results are compared, and their relative differences."""

from collections.abc import Mapping

import numpy as np
from scipy.interpolate import LinearNDInterpolator

from tkamb.contact.result import ContactResult
from tkamb.geometry.frames import SIDES
from tkamb.units import MILLIMETRE

PARTS = ("force", "mean_pressure", "peak_pressure", "area")
RASTER = MILLIMETRE
"""m: spacing of the raster on which pressure maps are compared."""

Quantities = dict[str, float]


def quantities(result: ContactResult) -> Quantities:
    """Return approach (m) and each condyle's force (N), mean and peak pressure (Pa), area (m²)."""
    values = {"approach": result.approach}
    for side in SIDES:
        condyle = getattr(result, side)
        for part in PARTS:
            values[f"{side}_{part}"] = 0.0 if condyle is None else float(getattr(condyle, part))
    return values


def errors(values: Mapping[str, float], reference: Mapping[str, float]) -> dict[str, float]:
    """Return relative errors: approach, force, mean_pressure, peak_pressure, area.

    Errors of force and area are relative to the sum over both condyles, errors of pressure to the
    higher one, so that a condyle that hardly touches does not dominate. The larger error of the two
    condyles is returned.
    """
    result = {"approach": _relative(values, reference, ["approach"], np.max)}
    for part in PARTS:
        names = [f"{side}_{part}" for side in SIDES]
        scale = np.sum if part in ("force", "area") else np.max
        result[part] = _relative(values, reference, names, scale)
    return result


def _relative(
    values: Mapping[str, float], reference: Mapping[str, float], names: list[str], scale: object
) -> float:
    assert callable(scale)
    own = np.array([values[name] for name in names])
    true = np.array([reference[name] for name in names])
    return float(np.abs(own - true).max() / scale(np.abs(true)))


Raster = dict[tuple[int, int], float]
"""Raster place (i along x, j along z) -> pressure (Pa), where there is any."""


def raster_of(stored: Mapping[str, float]) -> Raster:
    """Return a raster stored as "i j" -> Pa."""
    return {(int(i), int(j)): p for (i, j), p in ((k.split(), p) for k, p in stored.items())}


def raster_map(result: ContactResult) -> Raster:
    """Return the pressure map on the raster."""
    loaded = result.pressure > 0
    if not loaded.any():
        return {}
    across = result.points[:, [0, 2]]
    low = np.floor(across[loaded].min(axis=0) / RASTER).astype(int) - 1
    high = np.ceil(across[loaded].max(axis=0) / RASTER).astype(int) + 1
    near = (
        (across > (low - 3) * RASTER)
        & (across < (high + 3) * RASTER)
        & (result.normals[:, 1:2] > 0)
    ).all(axis=1)
    i, j = np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high, strict=True)))
    value = LinearNDInterpolator(across[near], result.pressure[near])
    p = np.nan_to_num(value(i * RASTER, j * RASTER))
    return {
        (int(a), int(b)): float(v)
        for a, b, v in zip(i.ravel(), j.ravel(), p.ravel(), strict=True)
        if v > 0
    }


def map_error(raster: Raster, reference: Raster) -> float:
    """Return the L2 norm of the maps' difference over that of the reference."""
    places = sorted(set(raster) | set(reference))
    own = np.array([raster.get(place, 0.0) for place in places])
    true = np.array([reference.get(place, 0.0) for place in places])
    return float(np.linalg.norm(own - true) / np.linalg.norm(true))
