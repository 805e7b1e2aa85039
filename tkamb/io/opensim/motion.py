"""A model's coordinates over time, their derivatives, and the generalised forces of the motion.

With the twist J_b of body b per unit of the coordinates (in ground, at ground's origin), its
momentum h_b there, gravity g at its centre of mass c and the other wrenches w_b that act on it, the
generalised forces are

    τ = Σ_b J_bᵀ (dh_b/dt - (c × m g, m g) - w_b).

Accelerations are computed from ground outwards. Each axis s with its angle or translation u(q) adds
s ü + (v × s) u̇, where v is the twist of the body or axis before it and × the cross product of
twists. Translations come first, then the rotations in turn, seen from the parent frame.

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

    Constraints and couplers play no part: each coordinate is taken as it is given.

    Args:
        kinematics: of the model.
        q: (f, n) coordinates, rad and m.
        rates: (f, n) their rates.
        accelerations: (f, n) their second derivatives by time.
        wrenches: body -> (f, 6) moment (N·m) above force (N) on it, in ground at ground's
            origin, such as the ground reaction on a foot.
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
    """Return what else must act on each body (f, b, 6), beside gravity and the given wrenches.

    Moment (N·m) above force (N), in ground at ground's origin; zero for ground. Over the bodies
    beyond a joint, this sums up to what muscles, ligaments and the joint itself exert on them.

    Args:
        kinematics: of the model.
        motion: at q.
        q: (f, n) coordinates.
        rates: (f, n) their rates.
        accelerations: (f, n) their second derivatives by time.
        wrenches: body -> (f, 6), as in `inverse_dynamics`.
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
    """Return the rate (f, b, 6) of each body's twist."""
    result = np.zeros_like(twists)
    speeds, axis_accelerations = kinematics.axis_rates(q, rates, second)
    first = 0
    for joint in kinematics.model.joints:
        count = len(joint.rotations)
        last = first + count + len(joint.translations)
        inboard, outboard = kinematics.bodies[joint.inboard], kinematics.bodies[joint.outboard]
        carrier = twists[:, kinematics.bodies[joint.parent]]
        total = np.zeros_like(carrier)
        # Translations lie in the parent frame, beneath the rotations.
        for a in (*range(first + count, last), *range(first, first + count)):
            axis, speed = motion.axes[:, a], speeds[:, a, None]
            total += axis * axis_accelerations[:, a, None] + _cross(carrier, axis) * speed
            carrier = carrier + axis * speed
        sign = -1.0 if joint.backwards else 1.0
        result[:, outboard] = result[:, inboard] + sign * total
        first = last
    return result


def _cross(twist: Array, axis: Array) -> Array:
    """Return the cross product (f, 6) of twists: the rate of an axis carried along."""
    omega, speed = twist[:, :3], twist[:, 3:]
    linear = np.cross(omega, axis[:, 3:]) + np.cross(speed, axis[:, :3])
    return np.hstack([np.cross(omega, axis[:, :3]), linear])


@dataclass(frozen=True)
class AngleUnitSettings:
    """How angles in degrees are told from angles in radians."""

    max_radians: float = 6.5
    """rad: largest joint angle that can be in radians. Chosen: a joint never exceeds a whole turn,
    6.28; in degrees the number is larger in most movements."""
    min_rotation_deg: float = 0.2
    """deg; a joint that rotates by less in a whole recording stands still, in either unit. Chosen:
    noise of a recording is of this size."""
    max_angle: float = 2.0 * np.pi
    """rad; no joint of a leg rotates further. Chosen: a whole turn."""


ANGLE_UNIT = AngleUnitSettings()


@dataclass(frozen=True, eq=False)
class CoordinateMotion:
    """Coordinates in the model's order, rad and m.

    Args:
        time: (f,) s.
        q: (f, n).
        rates: (f, n) per s.
        accelerations: (f, n) per s².
    """

    time: Array
    q: Array
    rates: Array
    accelerations: Array


def read_coordinates(kinematics: Kinematics, recorded: Table) -> tuple[Array, tuple[str, ...]]:
    """Return coordinates (f, n) rad and m, and those that a `.mot` or `.sto` does not hold.

    Those are at their defaults.

    Args:
        kinematics: of the model.
        recorded: with a column per coordinate, named as in the model or by its path.

    Raises:
        InputError: angles of unknown or impossible unit, or a gap.
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
    """Return the column of a coordinate's value: its name, or its path in a states file.

    There `/jointset/knee/flexion/value` stands beside `/jointset/knee/flexion/speed`.
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
    """Return radians per unit of the angles, as the file's header says.

    Raises:
        InputError: it does not, or their size contradicts it.
    """
    largest = max(float(np.abs(values).max()) for values in angles.values())
    worst = max(angles, key=lambda name: np.abs(angles[name]).max())
    if recorded.in_degrees is None:
        likely = "yes" if largest > ANGLE_UNIT.max_radians else "no (radians) or inDegrees=yes"
        raise InputError(
            f"does not say inDegrees ('{worst}' reaches {largest:.3g})",
            recorded.path,
            f"add the line inDegrees={likely} above its endheader",
        )
    if not recorded.in_degrees and largest > ANGLE_UNIT.max_radians:
        raise InputError(
            f"says inDegrees=no, but '{worst}' reaches {largest:.4g}, which no joint does in "
            "radians",
            recorded.path,
            "write inDegrees=yes where it is in degrees",
        )
    return DEGREE if recorded.in_degrees else 1.0


def angle_lines(kinematics: Kinematics, recorded: Table, q: Array) -> tuple[str, ...]:
    """Return lines on the unit of the angles where their size contradicts it.

    Args:
        kinematics: of the model.
        recorded: the file.
        q: (f, n) coordinates that were read from it, rad and m.
    """
    coordinates = kinematics.model.coordinates
    own = [kinematics.coordinates[name] for name in coordinates if coordinates[name].rotational]
    turns = np.ptp(q[:, own], axis=0) / DEGREE
    small = np.abs(q[:, own]).max() < ANGLE_UNIT.max_radians * DEGREE
    if recorded.in_degrees and small and turns.max() > ANGLE_UNIT.min_rotation_deg:
        return (
            "ATTENTION: by inDegrees=yes no joint of the whole motion bends or turns by more than "
            f"{turns.max():.2g} deg: check whether the file is in radians",
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
    """Low-pass filter coordinates and differentiate them twice; followers follow exactly.

    A coordinate c = f(q) that a coupler moves has c' = f' q' and c'' = f' q'' + f'' q'².

    Args:
        kinematics: of the model.
        time: (m,) s.
        q: (m, n) coordinates; those that follow others are not looked at.
        cutoff_Hz: as in `differentiate_coordinates`, which states the errors too.
        at: (f,) s, where they are wanted; default: at `time`.
        name: what to call the data in messages.
    """
    values, rates, second = differentiate_coordinates(time, q, cutoff_Hz, at, name=name)
    for coupler in kinematics.model.couplers:
        dependent = kinematics.coordinates[coupler.dependent]
        own = kinematics.coordinates[coupler.independent]
        slope = coupler.function.slope(values[:, own])
        bend = coupler.function.curvature(values[:, own])
        values[:, dependent] = coupler.function(values[:, own])
        rates[:, dependent] = slope * rates[:, own]
        second[:, dependent] = slope * second[:, own] + bend * rates[:, own] ** 2
    return CoordinateMotion(time if at is None else np.asarray(at, float), values, rates, second)
