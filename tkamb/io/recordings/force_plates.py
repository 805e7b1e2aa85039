"""Force plates of a C3D file: from channels to the wrench of the ground on the foot.

A plate's axes follow from its corners, in the order of the format: x from corner 2 to corner 1,
y from corner 4 to corner 1, and z = x × y, which points down if the plate is horizontal. The
channels give the force and the moment about the transducers' origin in these axes:

    type 1   Fx Fy Fz Px Py Tz: the force, its point on the surface and the free moment
    type 2   Fx Fy Fz Mx My Mz
    type 3   Fx12 Fx34 Fy14 Fy23 Fz1 Fz2 Fz3 Fz4, with a, b, z0 = ORIGIN:
             M = (b (Fz1 + Fz2 - Fz3 - Fz4), a (Fz2 + Fz3 - Fz1 - Fz4),
                  b (Fx34 - Fx12) + a (Fy14 - Fy23))
    type 4   as type 2 after the calibration matrix (6, 6)
    type 5   as type 2 after a calibration matrix (6, 8) of eight channels

A calibration matrix gives forces in N (or FORCE_PLATFORM:UNITS) and moments in that unit times
POINT:UNITS. The channels of a type 4 plate may state other units. The units that put the centre of
pressure on the plate are then used.

ORIGIN is the vector o from the transducers' origin to the centre of the surface. The moment about
this centre is M - o × F. The centre of pressure is not returned: it needs a force threshold.

FORCE_PLATFORM:ZERO names frames without load. The mean of each channel over these frames is
subtracted, unless the plate is loaded in them.

Source: C3D user guide, FORCE_PLATFORM; Kistler's formulae for four three-component sensors.

A plate states its moments, or its points, in a unit of length. If this unit is wrong, the centre of
pressure leaves the surface, or it rests at the transducers' origin as no foot does.
"""

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.recordings.laboratory import GivenUnits, metres, newton_metres, newtons
from tkamb.units import LENGTH

# N: vertical force above which the centre of pressure is checked. A smaller force
# makes it a quotient of small numbers.
LOADED_N = 100.0
# 1: share of the plate's half width by which the median centre of pressure may lie outside the
# corners. A loaded plate has smaller errors.
BESIDE = 0.2
# 1: if 95 % of the centres of pressure are closer to the transducers' origin than this share of
# both half widths, below a millimetre, the moments are too small. A foot's centre of pressure
# moves by centimetres.
RESTING = 0.003
# 1: another unit is accepted only if the farthest centre of pressure (95 %) is farther from the
# transducers' origin than this share of a half width.
MOVING = 0.05


USUAL, UNUSUAL = ("mm", "m"), ("cm", "inch")
"""Units of length in moments, tried in this order if the stated one is impossible."""


@dataclass(frozen=True)
class PressureRange:
    """Where the centres of pressure of a loaded plate lie, as shares of its half widths.

    Args:
        median: (2,) median distance from the surface's centre along x and y.
        origin: (2,) distance from the transducers' origin that 95 % of the samples keep.
    """

    median: Array
    origin: Array

    @property
    def beside(self) -> bool:
        """Whether most centres of pressure lie beside the surface."""
        return bool((self.median > 1.0 + BESIDE).any())

    @property
    def resting(self) -> bool:
        """Whether the centre of pressure rests at the transducers' origin."""
        return bool((self.origin < RESTING).all())

    @property
    def usual(self) -> bool:
        """Whether the centres of pressure are those of a foot on the plate."""
        return not self.beside and bool((self.origin > MOVING).any())


def pressure_range(
    corners: Array, force: Array, moment: Array, origin: Array
) -> PressureRange | None:
    """Return where the centres of pressure lie; None if the plate is not loaded.

    Args:
        corners: (4, 3) m.
        force: (k, 3) N, in the plate's axes.
        moment: (k, 3) N·m about the surface's centre, in the plate's axes.
        origin: (3,) m, vector from the transducers' origin to the surface's centre.
    """
    loaded = (np.abs(force[:, 2]) > LOADED_N) & np.isfinite(moment).all(axis=1)
    if not loaded.any():
        return None
    half = 0.5 * np.linalg.norm([corners[0] - corners[1], corners[0] - corners[3]], axis=1)
    shares = []
    for about in (moment[loaded], moment[loaded] + np.cross(origin, force[loaded])):
        point = np.stack([-about[:, 1], about[:, 0]], axis=1) / force[loaded, 2:3]
        shares.append(np.abs(point) / half)
    return PressureRange(np.median(shares[0], axis=0), np.percentile(shares[1], 95, axis=0))


def other_units(stated_m: float) -> Iterator[tuple[tuple[str, float], ...]]:
    """Yield groups of names and metres of units of length other than the stated one (m)."""
    for names in (USUAL, UNUSUAL):
        units = tuple((name, LENGTH[name]) for name in names)
        yield tuple(unit for unit in units if abs(unit[1] / stated_m - 1.0) > 1e-6)


CHANNELS = {1: 6, 2: 6, 3: 8, 4: 6, 5: 8}
"""Plate types that are read -> number of channels."""
_CALIBRATED = (4, 5)
_log = logging.getLogger("tkamb")


# N: largest standard deviation of the vertical force of an unloaded plate, over the frames of
# ZERO. A foot strike or toe-off gives more.
STEADY_N = 10.0
# N: largest mean vertical force, over the frames of ZERO, that counts as drift of the amplifier.
# A foot exerts more.
BASELINE_N = 20.0
# 1: as `BASELINE_N`, but a share of the largest change of the vertical force; the larger limit
# holds. A standing person exerts more.
BASELINE_SHARE = 0.2


@dataclass(frozen=True, eq=False)
class PlateRecord:
    """One plate as the file describes it.

    Args:
        number: number of the plate, from 1.
        kind: 1 to 5.
        corners: (4, 3) m, corners of the surface.
        origin: (3,) m, the file's ORIGIN.
        signals: (c, k) samples of the channels, in the file's units.
        calibration: (6, c), matrix from channels to force and moment (types 4 and 5), or None.
        zero: samples in which the file states the plate as unloaded, or None.
        given: the user's units.
        moment_length: metres that stand for the length in moments, or in the points of type 1 and
            the ORIGIN of type 3; None: as the units state.
    """

    number: int
    kind: int
    corners: Array
    origin: Array
    names: tuple[str, ...]
    signals: Array
    units: tuple[str, ...]
    calibration: Array | None
    force_unit: str
    metres_per_unit: float
    zero: slice | None
    given: GivenUnits
    where: str
    moment_length: float | None = None


@dataclass(frozen=True, eq=False)
class ForcePlate:
    """One plate, in the axes of the file.

    Args:
        corners: (4, 3) m, corners of the surface.
        force: (k, 3) N, on the foot; NaN where the file has no value.
        moment: (k, 3) N·m, on the foot, about the centre of the surface.
    """

    number: int
    channels: tuple[str, ...]
    corners: Array
    force: Array
    moment: Array
    notices: tuple[str, ...] = field(default=())

    @property
    def centre(self) -> Array:
        """Centre (3,) m of the surface."""
        return np.asarray(self.corners.mean(axis=0))

    @property
    def wrench(self) -> Array:
        """Wrench (k, 6): force (N) and moment about the file's origin (N·m)."""
        return np.concatenate([self.force, self.moment + np.cross(self.centre, self.force)], axis=1)


def force_plate(record: PlateRecord) -> ForcePlate:
    """Return the wrench that a plate measured."""
    kind, where = record.kind, record.where
    if kind not in CHANNELS:
        raise InputError(f"is of type {kind}", where, "use a plate of type 1 to 5")
    if len(record.signals) < CHANNELS[kind]:
        what = f"has {len(record.signals)} of {CHANNELS[kind]} channels"
        raise InputError(what, where, "export the trial again")
    if not np.isfinite(record.signals).any():
        raise InputError("holds no value that is a number", where, "export the trial again")
    axes = _axes(record.corners, where)
    origin = record.origin
    if origin[2] > 0 and kind != 1:
        _log.warning("%s: ORIGIN puts the surface below the sensors; its sign is reversed", where)
        origin = origin * (np.array([1.0, 1.0, -1.0]) if kind == 3 else -1.0)
    record = replace(record, origin=origin)
    force, moment, notices = _read(record)
    if record.zero is not None:
        level = record.signals[:, record.zero].mean(axis=1)
        if kind == 1:
            level[3:5] = 0.0  # the point of the force has no baseline
        reason = _loaded_in_zero(record, force)
        if reason:
            notices += (reason,)
        elif np.isfinite(level).all():
            record = replace(record, signals=record.signals - level[:, None])
            force, moment, notices = _read(record)
    force, moment, more = _in_possible_unit(record, force, moment)
    notices += more
    return ForcePlate(
        record.number, record.names, record.corners, force @ axes.T, moment @ axes.T, notices
    )


def _in_possible_unit(
    record: PlateRecord, force: Array, moment: Array
) -> tuple[Array, Array, tuple[str, ...]]:
    """Return force and moment in the unit that puts the centre of pressure on the plate; arguments
    as in `pressure_range`.

    Another unit than the file's is used, with a notice, only if that is impossible and exactly one
    other is possible. The user's unit is kept.
    """
    stated = pressure_range(record.corners, force, moment, _above_transducers(record))
    if stated is None or not (stated.beside or stated.resting):
        return force, moment, ()
    given = record.given.length if record.kind in (1, 3) else record.given.moment
    for units in other_units(_stated_length(record)) if given is None else ():
        possible = []
        for name, length in units:
            other = replace(record, moment_length=length)
            result = _read(other)[:2]
            where = pressure_range(record.corners, *result, _above_transducers(other))
            if where is not None and where.usual:
                possible.append((name, result))
        if len(possible) == 1:
            name, result = possible[0]
            quantity = {1: "points", 3: "ORIGIN"}.get(record.kind, "moments")
            unit = name if record.kind in (1, 3) else f"N·{name}"
            return *result, (
                f"force plate {record.number}: with its stated unit of {quantity} the centre of "
                f"pressure {'is beside the plate' if stated.beside else 'never moves'}; {unit} "
                "puts it under a foot and is used",
            )
    problem = (
        f"lies beside the plate, at {stated.median.max():.1f} half widths from its centre"
        if stated.beside
        else "never moves from the transducers' origin"
    )
    words = f"the centre of pressure {problem}: check units, CORNERS and ORIGIN"
    return force, moment, (f"force plate {record.number}: {words}",)


def _above_transducers(record: PlateRecord) -> Array:
    """Return (3,) m from the transducers' origin to the surface's centre."""
    if record.kind == 1:
        return np.zeros(3)
    return record.origin * (np.array([0.0, 0.0, 1.0]) if record.kind == 3 else 1.0)


def _stated_length(record: PlateRecord) -> float:
    if record.kind == 3:
        return record.metres_per_unit
    if record.kind in _CALIBRATED:
        stated = _stated_scales(record) if record.kind == 4 else None
        return record.metres_per_unit if stated is None else float(stated[3] / stated[0])
    scales = _scales(record)
    return float(scales[3] if record.kind == 1 else scales[3] / scales[0])


def _loaded_in_zero(record: PlateRecord, force: Array) -> str:
    """Return the reason not to subtract the mean over the frames of ZERO, or ""."""
    assert record.zero is not None
    vertical = force[:, 2]
    window = vertical[record.zero]
    level, spread = float(window.mean()), float(window.std())
    change = np.nanmax(np.abs(vertical - level)) if np.isfinite(level) else 0.0
    drift = abs(level) <= max(BASELINE_N, BASELINE_SHARE * change)
    if drift and spread <= STEADY_N:
        return ""
    return (
        f"force plate {record.number} shows {abs(level):.0f} N in the frames that "
        "FORCE_PLATFORM:ZERO states as unloaded: no baseline is subtracted"
    )


def _read(record: PlateRecord) -> tuple[Array, Array, tuple[str, ...]]:
    """Return force (k, 3) N, moment (k, 3) N·m about the surface's centre, in the plate's axes, and
    notices.
    """
    length = record.moment_length
    if record.kind not in _CALIBRATED:
        factors, origin = _scales(record), record.origin
        if length is not None and record.kind == 3:
            origin = origin * length / record.metres_per_unit
        elif length is not None:
            factors[3:] = [length, length, factors[5]] if record.kind == 1 else factors[:3] * length
        return (*_wrench(record.kind, record.signals * factors[:, None], origin), ())
    matrix = record.calibration
    stated = _stated_scales(record) if record.kind == 4 else None
    if matrix is None and stated is not None:
        matrix = np.eye(6)  # channels in units of force and moment are calibrated already
    if matrix is None or matrix.shape != (6, len(record.signals)):
        what = f"is of type {record.kind} without CAL_MATRIX"
        raise InputError(what, record.where, "export it with the matrix")
    unit = newtons(record.given.force or record.force_unit)
    if unit is None:
        raise _no_unit(record, record.force_unit, "force_unit", "N")
    scales = np.repeat([unit, unit * (length or record.metres_per_unit)], 3)
    if record.given.moment is not None:
        scales[3:] = _given_moment(record)
    wrench = matrix @ record.signals
    result = _wrench(2, wrench * scales[:, None], record.origin)
    if length is not None or stated is None or np.allclose(stated, scales, rtol=1e-9):
        return (*result, ())
    other = _wrench(2, wrench * stated[:, None], record.origin)
    inside = [_on_plate(record, *candidate) for candidate in (result, other)]
    if inside[0] == inside[1]:
        raise InputError(
            f"is of type {record.kind}, and its channels state another unit of moment than "
            "POINT:UNITS gives",
            record.where,
            "state the unit with --moment-unit or [ground_reaction] moment_unit",
        )
    return (*(result if inside[0] else other), ())


def _on_plate(record: PlateRecord, force: Array, moment: Array) -> bool:
    """Return whether the centre of pressure is on the plate, or the plate is not loaded."""
    where = pressure_range(record.corners, force, moment, _above_transducers(record))
    return where is None or where.usual


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
    x, y = corners[0] - corners[1], corners[0] - corners[3]
    z = np.cross(x, y)
    if not np.isfinite(corners).all() or not np.linalg.norm(z) >= 1e-4:
        raise InputError("has corners that span no surface", where, "export the trial again")
    y = np.cross(z, x)
    return np.stack([axis / np.linalg.norm(axis) for axis in (x, y, z)], axis=1)


def _stated_scales(record: PlateRecord) -> Array | None:
    readers = (newtons,) * 3 + (newton_metres,) * 3
    result = [read(unit) for read, unit in zip(readers, record.units, strict=False)]
    return None if None in result or len(result) < 6 else np.array(result, float)


def _given_moment(record: PlateRecord) -> float:
    unit = newton_metres(record.given.moment or "")
    if unit is None:
        what = f"'{record.given.moment}' is no unit of moment"
        raise InputError(what, "moment_unit", "give for example Nm")
    return unit


def _scales(record: PlateRecord) -> Array:
    kinds = {1: "fffllm", 3: "ffffffff"}.get(record.kind, "fffmmm")
    readers = {"f": newtons, "m": newton_metres, "l": metres}
    keys = {"f": "force_unit", "m": "moment_unit", "l": "length_unit"}
    units = {"f": record.given.force, "m": record.given.moment, "l": record.given.length}
    examples = {"f": "N", "m": "Nmm", "l": "mm"}
    scales = []
    for quantity, unit in zip(kinds, record.units, strict=False):
        scale = readers[quantity](unit)
        text = units[quantity]
        stated = None if text is None else readers[quantity](text)
        if text is not None and stated is None:
            what = f"'{text}' is no unit of {keys[quantity].removesuffix('_unit')}"
            raise InputError(what, keys[quantity], f"give for example {examples[quantity]}")
        if scale is not None and stated is not None and quantity != "l" and stated != scale:
            raise InputError(
                f"has a channel in '{unit}', but {keys[quantity]} says '{text}'",
                record.where,
                f"correct {keys[quantity]}",
            )
        if scale is None and stated is None:
            raise _no_unit(record, unit, keys[quantity], examples[quantity])
        scales.append(stated if scale is None else scale)
    return np.array(scales, float)


def _no_unit(record: PlateRecord, unit: str, key: str, example: str) -> InputError:
    stated = f"the unit '{unit}'" if unit else "no unit"
    option = f"--{key.replace('_', '-')}"
    return InputError(
        f"has a channel with {stated} (ANALOG:UNITS), which is not understood",
        record.where,
        f"state what it means with {option} or [ground_reaction] {key}, as in {example}",
    )


# N: smallest load, above the unloaded level. 20 N is usual for ground reactions.
LOAD_N = 20.0
# s: time before and after a load in which the wrench is used. A foot strikes or
# leaves within 0.02 s.
MARGIN_S = 0.05
# 1: this share of the samples, those with the smallest forces, is taken as unloaded. Their median
# is the unloaded level. A plate is usually unloaded for longer.
QUIET_SHARE = 0.1
# N: largest range of these samples. A larger range gives no unloaded level. The
# force of a foot varies more.
QUIET_SPREAD_N = 2.0
# N: largest unloaded level that counts as drift. A foot exerts more.
MOST_DRIFT_N = 60.0
# N: a larger unloaded level gets a note. The median of noise is zero, and 2 N
# change the force of the knee by less than 0.5 % of a body weight.
DRIFT_N = 2.0
# s: shortest unloaded time from which drift is computed. A foot in swing leaves the
# plate for longer.
UNLOADED_S = 0.1


def around_load(force: Array, time: Array) -> np.ndarray:
    """Return whether each sample of a force (k,), N, is within `margin_s` of a loaded one."""
    forces = np.sort(force[np.isfinite(force)])
    smallest = forces[: math.ceil(QUIET_SHARE * len(forces))]
    steady = len(smallest) and np.ptp(smallest) <= QUIET_SPREAD_N and smallest[-1] <= MOST_DRIFT_N
    loaded = np.flatnonzero(force >= LOAD_N + (float(np.median(smallest)) if steady else 0.0))
    if not len(loaded):
        return np.zeros(len(force), bool)
    after = np.searchsorted(loaded, np.arange(len(force)))
    nearest = np.minimum(
        np.abs(time[loaded[np.minimum(after, len(loaded) - 1)]] - time),
        np.abs(time - time[loaded[np.maximum(after - 1, 0)]]),
    )
    return np.asarray(nearest <= MARGIN_S)


def unloaded_level(vertical: Array, on: np.ndarray, time: Array) -> float:
    """Return the median (N) of the vertical force of the unloaded plate.

    It is zero if the plate is unloaded for less than `unloaded_s`.

    Args:
        vertical: (k,) N, vertical force.
        on: (k,) whether the plate is loaded, from `around_load`.
        time: (k,) s.
    """
    unloaded = vertical[~on & np.isfinite(vertical)]
    step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    return float(np.median(unloaded)) if len(unloaded) * step >= UNLOADED_S else 0.0
