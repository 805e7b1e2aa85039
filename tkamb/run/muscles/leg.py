"""Which coordinates and muscles of a model belong to a leg, and what loads its foot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.importing.anatomy import Leg, find_leg
from tkamb.io.opensim.model import AnyPathPoint, Joint, OpenSimModel, OpenSimMuscle, PathPoint
from tkamb.io.recordings.ground_reaction import GroundReaction

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
