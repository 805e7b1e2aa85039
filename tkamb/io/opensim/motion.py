"""A model's coordinates over time, their derivatives, and the generalised forces of the motion.

Let J_b be the twists of body b per unit of the coordinates, h_b its momentum, c its centre of mass
and w_b the wrench of given loads on it, all in ground at ground's origin. With gravity g, the
generalised forces are

    τ = Σ_b J_bᵀ (dh_b/dt - (c × m g, m g) - w_b).

Accelerations are computed from ground outwards: a joint axis s with the angle or translation u(q)
adds s ü + (v × s) u̇. Here v is the twist of the previous body or axis, and × is the cross product
of twists. Within a joint, the translations precede the rotations.

Reference: Featherstone, Rigid Body Dynamics Algorithms (2008), chapters 2 and 5.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.opensim.kinematics import Kinematics, Motion
from tkamb.io.recordings.filtering import Cutoff, differentiate_coordinates
from tkamb.io.recordings.tables import Table
from tkamb.units import DEGREE


def inverse_dynamics(
    kinematics: Kinematics,
    q: Array,
    rates: Array,
    accelerations: Array,
    wrenches: Mapping[str, Array] | None = None,
) -> Array:
    """Return the generalised forces τ (f, n), N·m and N, one for each coordinate.

    Every coordinate counts as independent, without constraints and couplers.

    Args:
        q: coordinates, rad and m, (f, n).
        rates: first time derivatives, (f, n).
        accelerations: second time derivatives, (f, n).
        wrenches: body -> moment (N·m) above force (N) on the body, in ground at ground's origin,
            (f, 6), for example the ground reaction on a foot.
    """
    motion = kinematics.motion(q)
    needed = required_wrenches(kinematics, motion, q, rates, accelerations, wrenches)
    return np.einsum("fbin,fbi->fn", motion.twists, needed)


def required_wrenches(
    kinematics: Kinematics,
    motion: Motion,
    q: Array,
    rates: Array,
    accelerations: Array,
    wrenches: Mapping[str, Array] | None = None,
) -> Array:
    """Return the wrench (f, b, 6) that each body needs beyond gravity and given wrenches.

    A wrench is the moment (N·m) above the force (N), in ground at ground's origin; it is zero for
    ground. The sum over the bodies outboard of a joint is the wrench that muscles, ligaments and
    the joint exert on them.

    Args:
        q: coordinates, rad and m, (f, n).
        rates: first time derivatives of the coordinates, (f, n).
        accelerations: second time derivatives of the coordinates, (f, n).
    """
    twists = np.einsum("fbin,fn->fbi", motion.twists, rates)
    result = np.zeros_like(twists)
    twist_rates = _accelerations(kinematics, motion, twists, q, rates, accelerations)
    for name, body in kinematics.model.bodies.items():
        b = kinematics.bodies[name]
        rotation = motion.poses[:, b, :3, :3]
        centre = rotation @ body.centre + motion.poses[:, b, :3, 3]
        tensor = rotation @ body.inertia @ np.swapaxes(rotation, -1, -2)
        omega, alpha = twists[:, b, :3], twist_rates[:, b, :3]
        speed = twists[:, b, 3:] + np.cross(omega, centre)
        acceleration = twist_rates[:, b, 3:] + np.cross(alpha, centre) + np.cross(omega, speed)
        force = body.mass_kg * (acceleration - kinematics.model.gravity)
        angular_momentum = np.einsum("fij,fj->fi", tensor, omega)
        moment = np.einsum("fij,fj->fi", tensor, alpha) + np.cross(omega, angular_momentum)
        result[:, b] = np.hstack([np.cross(centre, force) + moment, force])
        if wrenches is not None and name in wrenches:
            result[:, b] -= wrenches[name]
    return result


def _accelerations(
    kinematics: Kinematics, motion: Motion, twists: Array, q: Array, rates: Array, second: Array
) -> Array:
    """Return the time derivative (f, b, 6) of each body's twist."""
    result = np.zeros_like(twists)
    speeds, axis_accelerations = kinematics.axis_rates(q, rates, second)
    first = 0
    for joint in kinematics.model.joints:
        count = len(joint.rotations)
        last = first + count + len(joint.translations)
        inboard, outboard = kinematics.bodies[joint.inboard], kinematics.bodies[joint.outboard]
        carrier = twists[:, kinematics.bodies[joint.parent]]
        total = np.zeros_like(carrier)
        # Translation axes are fixed to the parent frame, so that they precede the rotations.
        for a in (*range(first + count, last), *range(first, first + count)):
            axis, speed = motion.axes[:, a], speeds[:, a, None]
            total += axis * axis_accelerations[:, a, None] + _cross(carrier, axis) * speed
            carrier = carrier + axis * speed
        sign = -1.0 if joint.backwards else 1.0
        result[:, outboard] = result[:, inboard] + sign * total
        first = last
    return result


def _cross(twist: Array, axis: Array) -> Array:
    """Return the rate (f, 6) of an axis that moves with a twist."""
    omega, speed = twist[:, :3], twist[:, 3:]
    linear = np.cross(omega, axis[:, 3:]) + np.cross(speed, axis[:, :3])
    return np.hstack([np.cross(omega, axis[:, :3]), linear])


# rad: a larger joint angle cannot be in radians. No joint exceeds a whole turn,
# 6.28, while angles in degrees are larger in most movements.
MAX_RADIANS = 6.5
# deg: a joint that rotates by less in a whole recording is considered fixed. The
# noise of a recording is about as large.
MIN_ROTATION_DEG = 0.2


@dataclass(frozen=True, eq=False)
class CoordinateMotion:
    """Coordinates over time, in the model's order.

    Args:
        time: times, s, (f,).
        q: coordinates, rad and m, (f, n).
        rates: first time derivatives, per s, (f, n).
        accelerations: second time derivatives, per s², (f, n).
    """

    time: Array
    q: Array
    rates: Array
    accelerations: Array


def read_coordinates(kinematics: Kinematics, recorded: Table) -> tuple[Array, tuple[str, ...]]:
    """Return recorded coordinates, and the names of coordinates that the table lacks.

    Args:
        recorded: table (`.mot`, `.sto`) of the coordinates. A column has the coordinate's name or
            path in the model.

    Returns:
        Coordinates (f, n), rad and m, and names. Missing coordinates have their default values.

    Raises:
        InputError: the unit of angles is unknown or impossible, or a column has a gap.
    """
    model = kinematics.model
    q = np.tile(kinematics.vector({}), (recorded.rows, 1))
    result = {name: _column_of(name, recorded) for name in model.coordinates}
    missing = tuple(name for name, column in result.items() if column is None)
    columns = {name: recorded.complete_column(c) for name, c in result.items() if c is not None}
    angles = {name: v for name, v in columns.items() if model.coordinates[name].rotational}
    scale = _angle_scale(angles, recorded) if angles else 1.0
    for name, values in columns.items():
        q[:, kinematics.coordinates[name]] = values * (scale if name in angles else 1.0)
    return q, missing


def _column_of(name: str, recorded: Table) -> str | None:
    """Return the column of a coordinate's value, or None.

    A states file has `/jointset/knee/flexion/value` and `/jointset/knee/flexion/speed`.
    """
    paths = [column.split("/") for column in recorded.columns]
    readings = (
        lambda path: path == [name],
        lambda path: path[-2:] == [name, "value"],
        lambda path: len(path) > 1 and path[-1] == name,
    )
    for reading in readings:
        for path in paths:
            if reading(path):
                return "/".join(path)
    return None


def _angle_scale(angles: dict[str, Array], recorded: Table) -> float:
    """Return the file's unit of angles in rad."""
    largest = max(float(np.abs(values).max()) for values in angles.values())
    worst = max(angles, key=lambda name: np.abs(angles[name]).max())
    if recorded.in_degrees is None:
        likely = "yes" if largest > MAX_RADIANS else "no (radians) or inDegrees=yes"
        raise InputError(
            f"does not say inDegrees ('{worst}' reaches {largest:.3g})",
            recorded.path,
            f"add the line inDegrees={likely} above its endheader",
        )
    if not recorded.in_degrees and largest > MAX_RADIANS:
        raise InputError(
            f"says inDegrees=no, but '{worst}' reaches {largest:.4g}, which no joint does in "
            "radians",
            recorded.path,
            "write inDegrees=yes if the angles are in degrees",
        )
    return DEGREE if recorded.in_degrees else 1.0


def angle_lines(kinematics: Kinematics, recorded: Table, q: Array) -> tuple[str, ...]:
    """Return a remark if the angles are too small for their stated unit.

    Args:
        q: coordinates from the table, rad and m, (f, n).
    """
    coordinates = kinematics.model.coordinates
    angles = [kinematics.coordinates[name] for name in coordinates if coordinates[name].rotational]
    turns = np.ptp(q[:, angles], axis=0) / DEGREE
    small = np.abs(q[:, angles]).max() < MAX_RADIANS * DEGREE
    if recorded.in_degrees and small and turns.max() > MIN_ROTATION_DEG:
        return (
            "ATTENTION: with inDegrees=yes no joint rotates by more than "
            f"{turns.max():.2g} deg in the whole motion: check whether the file is in radians",
        )
    return ()


def coordinate_motion(
    kinematics: Kinematics,
    time: Array,
    q: Array,
    cutoff_Hz: Cutoff,
    at: Array | None = None,
    name: str = "motion",
) -> CoordinateMotion:
    """Low-pass filter coordinates and differentiate them twice.

    Dependent coordinates are computed from their couplers: c = f(q) has c' = f' q' and
    c'' = f' q'' + f'' q'².

    Args:
        time: times of the samples, s, (m,).
        q: coordinates, rad and m, (m, n). Values of dependent coordinates are ignored.
        cutoff_Hz: cut-off frequency, Hz, as in `differentiate_coordinates`.
        at: times of the result, s, (f,); None: `time`.
    """
    values, rates, second = differentiate_coordinates(time, q, cutoff_Hz, at, name=name)
    for coupler in kinematics.model.couplers:
        dependent = kinematics.coordinates[coupler.dependent]
        independent = kinematics.coordinates[coupler.independent]
        slope = coupler.function.slope(values[:, independent])
        curvature = coupler.function.curvature(values[:, independent])
        values[:, dependent] = coupler.function(values[:, independent])
        rates[:, dependent] = slope * rates[:, independent]
        second[:, dependent] = (
            slope * second[:, independent] + curvature * rates[:, independent] ** 2
        )
    return CoordinateMotion(time if at is None else np.asarray(at, float), values, rates, second)
