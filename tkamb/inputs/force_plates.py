"""Force plates of a C3D file: channels to the wrench that the ground exerts on the foot.

A plate's axes follow from its corners, in the order of the format: x from corner 2 to corner 1,
y from corner 4 to corner 1, z = x × y, down for a plate that lies. The channels give the force
and the moment about the transducers' origin in these axes:

    type 1   Fx Fy Fz Px Py Tz: the force, its point on the surface and the free moment
    type 2   Fx Fy Fz Mx My Mz
    type 3   Fx12 Fx34 Fy14 Fy23 Fz1 Fz2 Fz3 Fz4, with a, b, z0 = ORIGIN:
             M = (b (Fz1 + Fz2 - Fz3 - Fz4), a (Fz2 + Fz3 - Fz1 - Fz4),
                  b (Fx34 - Fx12) + a (Fy14 - Fy23))
    type 4   as type 2 after the calibration matrix, which gives N and N·mm

With o = ORIGIN from the transducers' origin to the surface's centre the moment there is
M - o × F. A centre of pressure is a quotient and is left to who knows the threshold.

Source: C3D user guide, FORCE_PLATFORM; Kistler's formulae for four three-component sensors.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.units import LENGTH, MILLIMETRE

CHANNELS = {1: 6, 2: 6, 3: 8, 4: 6}
"""Plate types that are read -> number of channels."""

_FORCE = {"N": 1.0, "kN": 1e3}
_MOMENT = {"Nm": 1.0, "Nmm": MILLIMETRE, "Ncm": 1e-2}
_log = logging.getLogger("tkamb")


@dataclass(frozen=True, eq=False)
class ForcePlate:
    """One plate, in the axes of the file.

    Args:
        number: as the file counts, from 1.
        channels: names of its channels.
        corners: (4, 3) m, of the surface.
        force: (k, 3) N, on the foot.
        moment: (k, 3) N·m, on the foot, about the centre of the surface.
    """

    number: int
    channels: tuple[str, ...]
    corners: Array
    force: Array
    moment: Array

    @property
    def centre(self) -> Array:
        """(3,) m, of the surface."""
        return np.asarray(self.corners.mean(axis=0))

    @property
    def wrench(self) -> Array:
        """(k, 6) force (N) and moment about the file's origin (N·m)."""
        return np.concatenate([self.force, self.moment + np.cross(self.centre, self.force)], axis=1)


def force_plate(
    number: int,
    kind: int,
    corners: Array,
    origin: Array,
    names: Sequence[str],
    signals: Array,
    units: Sequence[str],
    calibration: Array | None,
    where: str,
) -> ForcePlate:
    """Return the wrench that a plate measured.

    Args:
        number: of the plate, from 1.
        kind: its type, 1 to 4.
        corners: (4, 3) m.
        origin: (3,) m, the file's ORIGIN.
        names: of the channels.
        signals: (c, k) in the file's units.
        units: of the channels, as in the file.
        calibration: (6, 6), type 4: channels to force and moment.
        where: file and plate, for the message.

    Raises:
        InputError: a type or unit that is not read, too few channels, no surface or no
            calibration.
    """
    if kind not in CHANNELS:
        raise InputError(f"is of type {kind}", where, "types 1, 2, 3 and 4 are read")
    if len(signals) < CHANNELS[kind]:
        raise InputError(f"has {len(signals)} of {CHANNELS[kind]} channels", where, "export again")
    if not np.isfinite(signals).all():
        raise InputError("holds a value that is not a number", where, "export the trial again")
    if kind == 4:
        if calibration is None:
            raise InputError("is of type 4 without CAL_MATRIX", where, "export it with the matrix")
        signals, units = calibration @ signals, ["N"] * 3 + ["Nmm"] * 3
    signals = signals * _scales(kind, units, where)[:, None]
    if origin[2] > 0 and kind != 1:
        _log.warning("%s: ORIGIN points below the surface; its sign is taken as turned", where)
        origin = origin * (np.array([1.0, 1.0, -1.0]) if kind == 3 else -1.0)
    force, moment = _wrench(kind, signals, origin)
    axes = _axes(corners, where)
    return ForcePlate(number, tuple(names), corners, force @ axes.T, moment @ axes.T)


def _wrench(kind: int, s: Array, origin: Array) -> tuple[Array, Array]:
    """Return force and moment about the surface's centre, each (k, 3), in the plate's axes."""
    if kind == 3:
        a, b = origin[0], origin[1]
        force = np.stack([s[0] + s[1], s[2] + s[3], s[4:8].sum(axis=0)], axis=1)
        moment = np.stack(
            [
                b * (s[4] + s[5] - s[6] - s[7]),
                a * (s[5] + s[6] - s[4] - s[7]),
                b * (s[1] - s[0]) + a * (s[2] - s[3]),
            ],
            axis=1,
        )
        return force, moment - np.cross([0.0, 0.0, origin[2]], force)
    force = s[:3].T
    if kind == 1:
        point = np.stack([s[3], s[4], np.zeros_like(s[3])], axis=1)
        moment = np.cross(point, force)
        moment[:, 2] += s[5]
        return force, moment
    return force, s[3:6].T - np.cross(origin, force)


def _axes(corners: Array, where: str) -> Array:
    """Return the plate's axes (3, 3) as columns."""
    x, y = corners[0] - corners[1], corners[0] - corners[3]
    z = np.cross(x, y)
    if not np.isfinite(corners).all() or np.linalg.norm(z) < 1e-4:
        raise InputError("has corners that span no surface", where, "export the trial again")
    y = np.cross(z, x)
    return np.stack([axis / np.linalg.norm(axis) for axis in (x, y, z)], axis=1)


def _scales(kind: int, units: Sequence[str], where: str) -> Array:
    """Return SI per unit of each channel."""
    wrench = (_FORCE,) * 3 + (_MOMENT,) * 3
    point = (_FORCE,) * 3 + (LENGTH,) * 2 + (_MOMENT,)
    tables = {1: point, 3: (_FORCE,) * 8}.get(kind, wrench)
    scales = []
    for table, unit in zip(tables, units, strict=False):
        plain = unit.translate(str.maketrans("", "", " .*-·"))
        if plain not in table:
            stated = f"the unit '{unit}'" if unit else "no unit"
            raise InputError(
                f"has a channel with {stated} (ANALOG:UNITS)", where, f"one of {', '.join(table)}"
            )
        scales.append(table[plain])
    return np.array(scales)
