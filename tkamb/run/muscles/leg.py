"""Coordinates and muscles of a leg in an OpenSim model, their strength, and loads on its foot.

A Hill-type muscle has a rigid tendon. With the path length L, the slack length of the tendon, and
the constant width w = l_o sin(alpha_o) of the fibres,

    l cos(alpha) = L - l_slack,   l = sqrt(w² + (L - l_slack)²),   dl/dt = cos(alpha) dL/dt,

    F = (a f_l(l/l_o) f_v(dl/dt / (l_o v_max)) + f_p(l/l_o)) F_max cos(alpha).

f_l is a sum of three bells, f_v an arsinh, and f_p exponential beyond the optimal length. A path
shorter than the tendon is slack and does not pull. Some lines pull over a longer path than muscle
and tendon, such as past the patella to the tibia: L is then the path length of a twin muscle.

Reference: De Groote et al., Ann Biomed Eng 44:2922 (2016), doi:10.1007/s10439-016-1591-9; the
coefficients are those of the authors' code, with which f_l(1) = f_v(0) = 1.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
"""Height, place, width at length 0 and its growth, of each bell of the active force."""
VELOCITY = (-0.3211346127989808, -8.149, -0.374, 0.8825327733249912)


@dataclass(frozen=True)
class HillSettings:
    """Curves of force, length and velocity of a muscle."""

    passive_shape: float = 4.0
    """Shape of the passive curve (exponent); Thelen (2003) has 4 for adults under 65."""
    passive_strain: float = 0.6
    """Strain beyond the optimal length at which the passive force is F_max."""
    longest_fibre_ratio: float = 1.8
    """Fibre length over the optimal one beyond which the curves do not hold. Chosen: f_p(1.6) is 1
    already."""


HILL = HillSettings()


def active_force_length(length: Array) -> Array:
    """Return f_l at fibre lengths over the optimal one."""
    total = np.zeros_like(length)
    for height, place, width, growth in BELLS:
        total += height * np.exp(-0.5 * ((length - place) / (width + growth * length)) ** 2)
    return total


def force_velocity(velocity: Array) -> Array:
    """Return f_v at fibre velocities over the largest, positive where they lengthen.

    Held beyond ±1: fibres that shorten faster do not pull.
    """
    scale, slope, shift, level = VELOCITY
    inside = np.clip(velocity, -1.0, 1.0)
    return np.maximum(scale * np.arcsinh(slope * inside + shift) + level, 0.0)


def passive_force_length(length: Array) -> Array:
    """Return f_p at fibre lengths over the optimal one."""
    growth = HILL.passive_shape * np.maximum(length - 1.0, 0.0) / HILL.passive_strain
    return np.expm1(growth) / np.expm1(HILL.passive_shape)


def rigid_tendon_strength(
    muscles: Sequence[OpenSimMuscle], lengths_m: Array, speeds: Array
) -> tuple[Array, Array]:
    """Return the forces (..., m), N, at full activation without the passive one, and the passive.

    Args:
        muscles: m muscles.
        lengths_m: (..., m) of their paths.
        speeds: (..., m) m/s, of their paths' lengths.

    Returns:
        Both NaN where fibres are longer than `HILL.longest_fibre_ratio`.
    """
    optimal = np.array([muscle.optimal_fibre_length_m for muscle in muscles])
    slack = np.array([muscle.tendon_slack_length_m for muscle in muscles])
    width = optimal * np.sin([muscle.pennation_rad for muscle in muscles])
    fastest = optimal * np.array([muscle.max_contraction_velocity for muscle in muscles])
    strength = np.array([muscle.max_isometric_force_N for muscle in muscles])
    along = lengths_m - slack
    fibre = np.hypot(width, along)
    cosine = np.where(along > 0.0, along / np.maximum(fibre, 1e-300), 0.0)
    length = np.where(fibre > HILL.longest_fibre_ratio * optimal, np.nan, fibre / optimal)
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
"""Where a muscle's ends lie -> its group's name."""


@dataclass(frozen=True)
class ModelMatchSettings:
    """When two muscle lines are the same."""

    tolerance: float = 1e-6
    """Relative, or m: strengths, lengths and points that differ by less are the same. Chosen: above
    the rounding of files."""


MODEL_MATCH = ModelMatchSettings()


def leg_bones(leg: Leg) -> dict[str, tuple[str, ...]]:
    """Return femur, patella (if there is one), tibia and foot -> bodies, the bone's own first."""
    bones = {"femur": leg.femur, "tibia": leg.tibia, "foot": leg.foot}
    return bones if leg.patella is None else {**bones, "patella": (leg.patella,)}


def leg_coordinates(leg: Leg) -> tuple[str, ...]:
    """Return the coordinates that a leg's muscles balance.

    Those of the hip, the knee's flexion, those of the ankle and of the joint next below it
    (subtalar); none that is locked or follows another.

    Raises:
        InputError: a knee that does not bend.
    """
    if leg.flexion is None:
        raise InputError(f"has a knee '{leg.knee.name}' without flexion", leg.model.name)
    followers = {coupler.dependent for coupler in leg.model.couplers}

    def own(joint: Joint) -> list[str]:
        coordinates = leg.model.coordinates.values()
        result = [c for c in coordinates if c.joint == joint.name]
        return [c.name for c in result if not c.locked and c.name not in followers]

    below = [joint for joint in leg.model.joints if joint.inboard == leg.ankle.outboard]
    return (*own(leg.hip), leg.flexion, *own(leg.ankle), *(c for j in below for c in own(j)))


def leg_muscles(leg: Leg) -> tuple[str, ...]:
    """Return the enabled muscles that lead to or along a leg, twins left out (`length_twins`)."""
    bodies = {body for group in leg_bones(leg).values() for body in group}
    names = [
        muscle.name
        for muscle in leg.model.muscles.values()
        if muscle.enabled and any(point.body in bodies for point in muscle.path.points)
    ]
    twins = set(length_twins(leg.model).values())
    return tuple(name for name in names if name not in twins)


def muscle_groups(leg: Leg, muscles: Sequence[OpenSimMuscle]) -> dict[str, tuple[str, ...]]:
    """Return group -> names of its muscles, by the bones that a muscle's path ends on.

    The extensors of the knee end on the patella or lead past it; whatever lies above the thigh
    counts as thigh.
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
    """Return muscle -> its twin, where there is one.

    A twin has another's strength, fibre and tendon length and first point and a shorter path.
    Models hold such a copy where the path that pulls is longer than muscle and tendon, as one
    past the patella to the tibia: the twin's length is that of muscle and tendon, and it must
    not pull beside the other.
    """
    pairs = [p for p in combinations(model.muscles.values(), 2) if _same_muscle(*p)]
    ordered = [sorted(pair, key=lambda muscle: len(muscle.path.points)) for pair in pairs]
    return {whole.name: twin.name for twin, whole in ordered}


def foot_loads(model: OpenSimModel, reactions: Mapping[str, GroundReaction]) -> dict[str, Array]:
    """Return body -> (f, 6) moment above force on each foot, in ground at ground's origin.

    The body is the heaviest below the ankle, so that talus and toes are held through it.

    Args:
        model: whose ground is the laboratory, x forward, y up, z right.
        reactions: side -> ground reaction, none of them mirrored (loaded as of a right foot).
    """
    loads = {}
    for side, reaction in reactions.items():
        foot = max(find_leg(model, side).foot, key=lambda body: model.bodies[body].mass_kg)
        moment = np.cross(reaction.point, reaction.force) + reaction.moment
        loads[foot] = np.hstack([moment, reaction.force])
    return loads


def check_extensors(leg: Leg, muscles: tuple[str, ...]) -> None:
    """Raise where muscles end on a patella that does not follow the knee.

    Their moment about the knee then passes through a patellar ligament, which is no muscle: the
    patella's equilibrium has to be solved, and -dL/dq about the flexion is near zero.

    Raises:
        InputError: names them.
    """
    if leg.patella is None:
        return
    model = leg.model
    joint = next((j for j in model.joints if leg.patella in (j.parent, j.child)), None)
    own = {c.name for c in model.coordinates.values() if joint and c.joint == joint.name}
    following = {leg.flexion}
    for coupler in model.couplers:  # each after those that it follows
        following |= {coupler.dependent} if coupler.independent in following else set()
    if own & following:
        return
    ending = [n for n in muscles if model.muscles[n].path.points[-1].body == leg.patella]
    if ending:
        raise InputError(
            f"{', '.join(ending)} end on '{leg.patella}', which does not follow '{leg.flexion}'",
            model.name,
            "couple the patella to the knee, or leave the knee's flexion out of coordinates",
        )


def _same_muscle(one: OpenSimMuscle, other: OpenSimMuscle) -> bool:
    strong, weak = (
        np.array([m.max_isometric_force_N, m.optimal_fibre_length_m, m.tendon_slack_length_m])
        for m in (one, other)
    )
    first, second = one.path.points[0], other.path.points[0]
    return (
        bool((np.abs(strong - weak) <= MODEL_MATCH.tolerance * strong).all())
        and isinstance(first, PathPoint)
        and isinstance(second, PathPoint)
        and first.body == second.body
        and float(np.abs(first.location - second.location).max()) < MODEL_MATCH.tolerance
    )
