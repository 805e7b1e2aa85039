"""Coordinates, muscles, muscle strength and foot loads of a leg in an OpenSim model.

Hill-type muscles have a rigid tendon. With the path length L, the slack length l_slack of the
tendon and the constant width w = l_o sin(alpha_o) of the fibres,

    l cos(alpha) = L - l_slack,   l = sqrt(w² + (L - l_slack)²),   dl/dt = cos(alpha) dL/dt,

    F = (a f_l(l/l_o) f_v(dl/dt / (l_o v_max)) + f_p(l/l_o)) F_max cos(alpha).

f_l is a sum of three bell curves, f_v an arsinh, and f_p exponential beyond the optimal length. A
path shorter than the tendon has no force. Some paths are longer than muscle and tendon, such as a
path past the patella to the tibia; L is then that of the muscle's twin (`length_twins`).

Reference: De Groote et al., Ann Biomed Eng 44:2922 (2016), doi:10.1007/s10439-016-1591-9, with the
coefficients of the authors' code, for which f_l(1) = f_v(0) = 1.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.importing.anatomy import Leg, find_leg
from tkamb.io.opensim.model import AnyPathPoint, Joint, OpenSimModel, OpenSimMuscle, PathPoint
from tkamb.io.recordings.ground_reaction import GroundReaction

BELLS = (
    (0.8150671134243542, 1.055033428970575, 0.162384573599574, 0.063303448465465),
    (0.433004984392647, 0.716775413397760, -0.029947116970696, 0.200356847296188),
    (0.1, 1.0, 0.353553390593274, 0.0),
)
"""Bell curves of f_l: height, centre, width at length 0, and growth of the width with length."""
VELOCITY = (-0.3211346127989808, -8.149, -0.374, 0.8825327733249912)


# 1: exponent of the passive curve. Thelen (2003) has 4 for adults under 65.
PASSIVE_SHAPE = 4.0
# 1: strain beyond the optimal length at which the passive force is F_max.
PASSIVE_STRAIN = 0.6
# 1: largest fibre length over the optimal length for which the curves are valid.
# The passive force at 1.6 is F_max already.
LONGEST_FIBRE_RATIO = 1.8


def active_force_length(length: Array) -> Array:
    """Return f_l at lengths l/l_o."""
    total = np.zeros_like(length)
    for height, place, width, growth in BELLS:
        total += height * np.exp(-0.5 * ((length - place) / (width + growth * length)) ** 2)
    return total


def force_velocity(velocity: Array) -> Array:
    """Return f_v at velocities relative to the largest velocity, positive if fibres lengthen.

    f_v is constant beyond ±1, and zero for fibres that shorten faster.
    """
    scale, slope, shift, level = VELOCITY
    inside = np.clip(velocity, -1.0, 1.0)
    return np.maximum(scale * np.arcsinh(slope * inside + shift) + level, 0.0)


def passive_force_length(length: Array) -> Array:
    """Return f_p at lengths l/l_o."""
    growth = PASSIVE_SHAPE * np.maximum(length - 1.0, 0.0) / PASSIVE_STRAIN
    return np.expm1(growth) / np.expm1(PASSIVE_SHAPE)


def rigid_tendon_strength(
    muscles: Sequence[OpenSimMuscle], lengths_m: Array, speeds: Array
) -> tuple[Array, Array]:
    """Return the active forces at full activation and the passive forces, N, (..., m).

    Args:
        lengths_m: path lengths, m, (..., m).
        speeds: rates of the path lengths, m/s, (..., m).

    Returns:
        The forces, NaN for fibres longer than `LONGEST_FIBRE_RATIO`.
    """
    optimal = np.array([muscle.optimal_fibre_length_m for muscle in muscles])
    slack = np.array([muscle.tendon_slack_length_m for muscle in muscles])
    width = optimal * np.sin([muscle.pennation_rad for muscle in muscles])
    fastest = optimal * np.array([muscle.max_contraction_velocity for muscle in muscles])
    strength = np.array([muscle.max_isometric_force_N for muscle in muscles])
    along = lengths_m - slack
    fibre = np.hypot(width, along)
    cosine = np.where(along > 0.0, along / np.maximum(fibre, 1e-300), 0.0)
    length = np.where(fibre > LONGEST_FIBRE_RATIO * optimal, np.nan, fibre / optimal)
    active = active_force_length(length) * force_velocity(cosine * speeds / fastest)
    return strength * cosine * active, strength * cosine * passive_force_length(length)


EXTENSORS = "knee extensors"
GROUPS = {
    frozenset(["patella"]): EXTENSORS,
    frozenset(["thigh", "tibia"]): "thigh to shank",
    frozenset(["thigh", "foot"]): "thigh to foot",
    frozenset(["thigh"]): "across the hip",
    frozenset(["tibia", "foot"]): "shank to foot",
    frozenset(["tibia"]): "within the shank",
    frozenset(["foot"]): "within the foot",
}
"""Regions of a muscle's ends -> name of its group."""


# 1 or m: largest relative difference of strength and lengths, and largest distance of points.
# The rounding of files is smaller.
TOLERANCE = 1e-6


def leg_bones(leg: Leg) -> dict[str, tuple[str, ...]]:
    """Return bone (femur, patella if any, tibia, foot) -> its bodies."""
    bones = {"femur": leg.femur, "tibia": leg.tibia, "foot": leg.foot}
    return bones if leg.patella is None else {**bones, "patella": (leg.patella,)}


def leg_coordinates(leg: Leg) -> tuple[str, ...]:
    """Return the coordinates that muscles balance: hip, knee flexion, ankle and subtalar joint.

    Locked and dependent ones are excluded.
    """
    if leg.flexion is None:
        raise InputError(f"has a knee '{leg.knee.name}' without flexion", leg.model.name)
    followers = {coupler.dependent for coupler in leg.model.couplers}

    def free(joint: Joint) -> list[str]:
        coordinates = leg.model.coordinates.values()
        result = [c for c in coordinates if c.joint == joint.name]
        return [c.name for c in result if not c.locked and c.name not in followers]

    below = [joint for joint in leg.model.joints if joint.inboard == leg.ankle.outboard]
    return (*free(leg.hip), leg.flexion, *free(leg.ankle), *(c for j in below for c in free(j)))


# N·m: size of the reserve of the hip's coordinates, so large that it costs nothing.
# The abductors of scaled models are too weak for the moments of inverse dynamics. With 10 N·m the
# muscles that cross hip and knee supply them, and the knee's load is too large (docs/truth.md).
AT_HIP = 1e4
# N·m: size at knee, ankle and subtalar joint, as usual in static optimisation.
ELSEWHERE = 10.0


def default_reserves(leg: Leg) -> dict[str, float]:
    """Return coordinate -> size of its reserve, N·m."""
    coordinates = leg.model.coordinates
    return {
        name: AT_HIP if coordinates[name].joint == leg.hip.name else ELSEWHERE
        for name in leg_coordinates(leg)
    }


def leg_muscles(leg: Leg) -> tuple[str, ...]:
    """Return the enabled muscles with a path point on a leg, without twins (`length_twins`)."""
    bodies = {body for group in leg_bones(leg).values() for body in group}
    names = [
        muscle.name
        for muscle in leg.model.muscles.values()
        if muscle.enabled and any(point.body in bodies for point in muscle.path.points)
    ]
    twins = set(length_twins(leg.model).values())
    return tuple(name for name in names if name not in twins)


def muscle_groups(leg: Leg, muscles: Sequence[OpenSimMuscle]) -> dict[str, tuple[str, ...]]:
    """Return group -> names of its muscles, by the ends of their paths.

    Pelvis and thigh are one region; muscles that end on the patella or pass it are extensors.
    """
    bones = leg_bones(leg)

    def region(point: AnyPathPoint) -> str:
        return next((name for name in ("tibia", "foot") if point.body in bones[name]), "thigh")

    groups: dict[str, tuple[str, ...]] = dict.fromkeys(GROUPS.values(), ())
    for muscle in muscles:
        points = muscle.path.points
        group = GROUPS[frozenset([region(points[0]), region(points[-1])])]
        if leg.patella is not None and leg.patella in [point.body for point in points]:
            group = EXTENSORS
        groups[group] = (*groups[group], muscle.name)
    return {group: names for group, names in groups.items() if names}


def length_twins(model: OpenSimModel) -> dict[str, str]:
    """Return muscle -> its twin, if it has one.

    A twin is a copy with the same strength, fibre length, tendon length and first point, but fewer
    path points. Models have twins for paths past the patella to the tibia. Its path has the length
    of muscle and tendon; it must not pull itself.
    """
    pairs = [p for p in combinations(model.muscles.values(), 2) if _same_muscle(*p)]
    ordered = [sorted(pair, key=lambda muscle: len(muscle.path.points)) for pair in pairs]
    return {muscle.name: twin.name for twin, muscle in ordered}


def foot_loads(model: OpenSimModel, reactions: Mapping[str, GroundReaction]) -> dict[str, Array]:
    """Return body -> wrench (f, 6), in ground about its origin, moment first.

    It acts on the heaviest body below the ankle.

    Args:
        model: OpenSim model. Its ground is the laboratory, x forward, y up, z right.
        reactions: side -> ground reaction, not mirrored (loaded with side "right").
    """
    loads = {}
    for side, reaction in reactions.items():
        foot = max(find_leg(model, side).foot, key=lambda body: model.bodies[body].mass_kg)
        moment = np.cross(reaction.point, reaction.force) + reaction.moment
        loads[foot] = np.hstack([moment, reaction.force])
    return loads


def check_extensors(leg: Leg, muscles: tuple[str, ...]) -> None:
    """Raise if muscles end on a patella whose pose does not depend on the knee's flexion.

    A patellar ligament, which is no muscle, then transmits their moment to the tibia, so that
    -dL/dq about the flexion is near zero.
    """
    if leg.patella is None:
        return
    model = leg.model
    joint = next((j for j in model.joints if leg.patella in (j.parent, j.child)), None)
    patellar = {c.name for c in model.coordinates.values() if joint and c.joint == joint.name}
    following = {leg.flexion}
    for coupler in model.couplers:  # in the order of their dependence
        following |= {coupler.dependent} if coupler.independent in following else set()
    if patellar & following:
        return
    ending = [n for n in muscles if model.muscles[n].path.points[-1].body == leg.patella]
    if ending:
        raise InputError(
            f"{', '.join(ending)} end on '{leg.patella}', which is not coupled to '{leg.flexion}'",
            model.name,
            "couple the patella to the knee, or exclude the knee's flexion from coordinates",
        )


def _same_muscle(one: OpenSimMuscle, other: OpenSimMuscle) -> bool:
    values, other_values = (
        np.array([m.max_isometric_force_N, m.optimal_fibre_length_m, m.tendon_slack_length_m])
        for m in (one, other)
    )
    first, second = one.path.points[0], other.path.points[0]
    return (
        bool((np.abs(values - other_values) <= TOLERANCE * values).all())
        and isinstance(first, PathPoint)
        and isinstance(second, PathPoint)
        and first.body == second.body
        and float(np.abs(first.location - second.location).max()) < TOLERANCE
    )
