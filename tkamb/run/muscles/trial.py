"""Muscle forces of a whole recording by inverse dynamics and static optimisation.

Per frame, with the generalised forces τ of the motion (inertia, gravity, external loads) and the
moment arms R = -dL/dq of the muscles' lines about the balanced coordinates,

    τ_c = Σ_i R_ci (a_i F_i + P_i) + r_c.

F_i is a muscle's force at full activation and P_i its passive force. The reserve r_c is the moment
that the muscles do not provide. Activations a and reserves minimise

    Σ_i w_i a_i^p + Σ_c (r_c / ρ_c)²,   lowest <= a_i <= highest.

A coordinate that a coupler makes dependent on another adds to τ and R of that other coordinate by
the chain rule.

A taut muscle line is a chain of straight parts between points on bones and on their wrap objects.
A part from bone A at p to bone B at q pulls A at p along u = (q - p)/|q - p|, and B at q along -u.
The line acts on a bone through the straight parts that leave it: these are the effective
attachments. The virtual work of their wrenches is the moment arm,

    Σ_bones J_boneᵀ w_bone = -dL/dq.

Two parts of these wrenches are in no straight part. A wrap object that yields to a point inside it
(docs/opensim.md) pushes on its bone. Path points that move within their bone (the quadriceps of
gait2392) do work that is no wrench on any bone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import Array
from tkamb.io.importing.anatomy import Leg, find_leg
from tkamb.io.opensim.kinematics import Kinematics, Motion
from tkamb.io.opensim.model import OpenSimModel
from tkamb.io.opensim.motion import CoordinateMotion, required_wrenches
from tkamb.io.opensim.paths import LineSet, Pulls, StraightParts
from tkamb.run.muscles.leg import (
    check_extensors,
    leg_bones,
    leg_coordinates,
    leg_muscles,
    length_twins,
    rigid_tendon_strength,
)
from tkamb.run.muscles.sharing import FrameProblems, Sharing


@dataclass(frozen=True, eq=False)
class Attachments:
    """Where muscles pull one bone towards another, in the first one's frame.

    Args:
        points: (f, m, 3) m; NaN where a muscle has no straight part between the two.
        directions: (f, m, 3) unit vectors of the pull.
    """

    points: Array
    directions: Array


@dataclass(frozen=True, eq=False)
class Bones:
    """The bones of a leg and what acts on them.

    Args:
        names: b bones, such as femur, patella, tibia, foot.
        muscles: m names.
        poses: (f, b, 4, 4) of each bone's first body in ground.
        pulls: (f, m, b, 6) moment above force of unit tension on each bone, in ground at
            ground's origin.
        demand: (f, b, 6) what the motion takes beyond gravity and external loads, likewise, N·m
            above N; see `required_wrenches`.
        crossings: straight parts from bone to bone, -1 for bodies of none.
    """

    names: tuple[str, ...]
    muscles: tuple[str, ...]
    poses: Array
    pulls: Array
    demand: Array
    crossings: StraightParts

    def pull_on(self, bones: Sequence[str], seen_from: str) -> Array:
        """Return the wrench (f, m, 6) of unit tension on some bones taken together.

        Moment (N·m per N) above force (N per N), in the frame of bone `seen_from` about its
        origin.
        """
        total = self.pulls[:, :, [self.index(name) for name in bones]].sum(axis=2)
        return self._seen(total, seen_from)

    def demand_of(self, bones: Sequence[str], seen_from: str) -> Array:
        """Return what the motion of some bones takes (f, 6), in the same way."""
        total = self.demand[:, [self.index(name) for name in bones]].sum(axis=1)
        return self._seen(total[:, None], seen_from)[:, 0]

    def attachments(self, bone: str, towards: str | None) -> Attachments:
        """Return where and along what muscles pull a bone towards another.

        A muscle that leads from the one to the other more than once has its last straight part
        here; its wrench is the sum of all (`pull_on`).

        Args:
            bone: whose frame, point and pull.
            towards: the other bone; None: any body that is no bone of the leg, as the pelvis.
        """
        here = self.index(bone)
        there = -1 if towards is None else self.index(towards)
        points = np.full((len(self.poses), len(self.muscles), 3), np.nan)
        directions = points.copy()
        for own, other in ((0, 1), (1, 0)):
            bodies = self.crossings.bodies
            part = self.crossings.chosen(
                np.flatnonzero((bodies[:, own] == here) & (bodies[:, other] == there))
            )
            pose = self.poses[part.frame, here]
            step = part.ends[:, other] - part.ends[:, own]
            step /= np.linalg.norm(step, axis=1, keepdims=True)
            arm = part.ends[:, own] - pose[:, :3, 3]
            where = part.frame, part.line
            points[where] = np.einsum("pji,pj->pi", pose[:, :3, :3], arm)
            directions[where] = np.einsum("pji,pj->pi", pose[:, :3, :3], step)
        return Attachments(points, directions)

    def index(self, name: str) -> int:
        """Return the place of a bone.

        Raises:
            InputError: no such bone.
        """
        if name not in self.names:
            raise InputError(f"no bone '{name}'", "muscles", names_near(name, self.names))
        return self.names.index(name)

    def _seen(self, wrench: Array, bone: str) -> Array:
        """Return wrenches (f, k, 6) of ground at its origin in a bone's frame about its own."""
        pose = self.poses[:, self.index(bone)]
        moment = wrench[..., :3] - np.cross(pose[:, None, :3, 3], wrench[..., 3:])
        rotation = pose[:, :3, :3]
        return np.concatenate([moment @ rotation, wrench[..., 3:] @ rotation], axis=-1)


@dataclass(frozen=True, eq=False)
class MuscleTrial:
    """Muscles over a recording; frames that failed hold NaN.

    Args:
        time: (f,) s.
        muscles: m names.
        coordinates: c names of those that are balanced.
        activation: (f, m).
        force_N: (f, m).
        moment_arm_m: (f, m, c) -dL/dq, m per rad.
        moment: (f, c) τ, N·m, what muscles and reserves carry together.
        reserve: (f, c) r, N·m.
        kkt_residual: (f,) largest violation of the optimality conditions, relative.
        status: (f,) "ok" or "failed: …".
        bones: what acts on the bones.
    """

    time: Array
    muscles: tuple[str, ...]
    coordinates: tuple[str, ...]
    activation: Array
    force_N: Array
    moment_arm_m: Array
    moment: Array
    reserve: Array
    kkt_residual: Array
    status: tuple[str, ...]
    bones: Bones

    def muscle_wrench(self, bones: tuple[str, ...], seen_from: str) -> Array:
        """Return what all muscles exert on some bones taken together (f, 6).

        Moment (N·m) above force (N), in the frame of bone `seen_from` about its origin. On tibia
        and foot together that is the muscles which cross the knee: the others pull both ends.
        """
        pull = self.bones.pull_on(bones, seen_from)
        return np.einsum("fm,fmi->fi", self.force_N, pull)

    def knee_reaction(self) -> Array:
        """Return what the femur exerts on the tibia beside the muscles (f, 6), contact above all.

        Moment (N·m) above force (N), in the tibia's frame about its origin: what the motion of
        tibia and foot takes, less gravity, external loads and muscles.

        Raises:
            InputError: muscles that reach the tibia through a patellar ligament, which is none.
        """
        own = ("tibia", "foot")
        if "patella" in self.bones.names:
            patella = self.bones.attachments("patella", "tibia").points
            other = [None, "femur"]
            attachments = [self.bones.attachments("patella", bone).points for bone in other]
            ends = np.isfinite(attachments).any(axis=(0, 1, 3)) & ~np.isfinite(patella).any(
                axis=(0, 2)
            )
            if ends.any():
                names = [self.muscles[k] for k in np.flatnonzero(ends)]
                raise InputError(
                    f"{', '.join(names)} end on the patella; the patellar ligament's force on the "
                    "tibia is not known here",
                    "muscles",
                    "use a model whose quadriceps lines lead past the patella to the tibia",
                )
        return self.bones.demand_of(own, "tibia") - self.muscle_wrench(own, "tibia")


def solve_trial(
    model: OpenSimModel,
    motion: CoordinateMotion,
    loads: Mapping[str, Array],
    side: str = "right",
    sharing: Sharing | None = None,
) -> MuscleTrial:
    """Return the muscle forces of a leg in every frame of a motion.

    Args:
        model: the model; its locked coordinates stay as the motion has them.
        motion: its coordinates over time.
        loads: body -> (f, 6) moment (N·m) above force (N) on it, in ground at ground's origin,
            such as the ground reaction on either foot. NaN: not known, so that frames fail.
        side: "right" or "left".
        sharing: options.

    Raises:
        InputError: no such side, muscle, coordinate or body, or options out of range.
    """
    sharing = Sharing() if sharing is None else sharing
    leg = find_leg(model, side)
    balanced = leg_coordinates(leg) if sharing.coordinates is None else sharing.coordinates
    if leg.flexion in balanced:
        check_extensors(leg, leg_muscles(leg) if sharing.muscles is None else sharing.muscles)
    problem, bones = trial_problems(leg, motion, loads, sharing)
    frames = [problem.solved(k) for k in range(len(motion.q))]
    activation, reserve, residual = (
        np.array([frame[part] for frame in frames]) for part in range(3)
    )
    return MuscleTrial(
        motion.time,
        bones.muscles,
        balanced,
        activation,
        activation * problem.active + problem.passive,
        problem.arms,
        problem.moment,
        reserve,
        residual,
        tuple(frame[3] for frame in frames),
        bones,
    )


def trial_problems(
    leg: Leg, motion: CoordinateMotion, loads: Mapping[str, Array], sharing: Sharing
) -> tuple[FrameProblems, Bones]:
    """Return what every frame asks of a leg's muscles, and what acts on the bones.

    Args:
        leg: the leg.
        motion: as in `solve_trial`, as the others.
        loads: likewise.
        sharing: likewise.

    Raises:
        InputError: no such muscle, coordinate or body, or options out of range.
    """
    model, kinematics = leg.model, Kinematics(leg.model)
    names = leg_muscles(leg) if sharing.muscles is None else sharing.muscles
    balanced = leg_coordinates(leg) if sharing.coordinates is None else sharing.coordinates
    _check(kinematics, motion, loads, names, balanced, sharing)
    q, groups = motion.q, leg_bones(leg)
    bones = kinematics.motion(q)
    needed = required_wrenches(kinematics, bones, q, motion.rates, motion.accelerations, loads)
    own = kinematics.coupling(q)[:, :, [kinematics.coordinates[name] for name in balanced]]
    moment = np.einsum("fbin,fbi,fnc->fc", bones.twists, needed, own, optimize=True)
    pulls = LineSet(kinematics, names).pulls(q, list(groups.values()))
    arms = pulls.moment_arms @ own
    active, passive = _strength(kinematics, motion, sharing, pulls)
    muscles = [model.muscles[name] for name in names]
    problem = FrameProblems(muscles, balanced, sharing, moment, arms, active, passive)
    return problem, _bones(groups, bones, needed, pulls)


def _bones(
    groups: Mapping[str, Sequence[str]], bones: Motion, needed: Array, pulls: Pulls
) -> Bones:
    """Return the bones, of what each body needs (f, bodies, 6) and the muscles' pulls on groups."""
    places = [[bones.bodies[name] for name in bodies] for bodies in groups.values()]
    demand = np.stack([needed[:, place].sum(axis=1) for place in places], axis=1)
    poses = bones.poses[:, [place[0] for place in places]]
    return Bones(tuple(groups), pulls.names, poses, pulls.wrenches, demand, pulls.crossings)


def _strength(
    kinematics: Kinematics, motion: CoordinateMotion, sharing: Sharing, pulls: Pulls
) -> tuple[Array, Array]:
    """Return force at full activation and passive force (f, m), N."""
    model = kinematics.model
    muscles = [model.muscles[name] for name in pulls.names]
    if sharing.law == "isometric":
        strength = np.array([muscle.max_isometric_force_N for muscle in muscles])
        shape = pulls.lengths_m.shape
        return np.broadcast_to(strength, shape), np.zeros(shape)
    lengths, arms = pulls.lengths_m.copy(), pulls.moment_arms.copy()
    twins = length_twins(model)
    measured = [k for k, name in enumerate(pulls.names) if name in twins]
    if measured:
        lines = LineSet(kinematics, [twins[pulls.names[k]] for k in measured]).at(motion.q)
        lengths[:, measured], arms[:, measured] = lines.lengths_m, lines.moment_arms
    return rigid_tendon_strength(muscles, lengths, -np.einsum("fmn,fn->fm", arms, motion.rates))


def _check(
    kinematics: Kinematics,
    motion: CoordinateMotion,
    loads: Mapping[str, Array],
    muscles: Sequence[str],
    coordinates: Sequence[str],
    sharing: Sharing,
) -> None:
    """Raise an InputError for what is not there or out of range."""
    where, model = kinematics.model.name, kinematics.model
    for what, names, available in (
        ("body", loads, model.bodies),
        ("muscle", muscles, model.muscles),
        ("coordinate", coordinates, model.coordinates),
    ):
        for name in names:
            if name not in available:
                raise InputError(f"has no {what} '{name}'", where, names_near(name, available))
    if not muscles or not coordinates or len(set(coordinates)) < len(coordinates):
        raise InputError("needs muscles and coordinates, each once", where)
    for name in coordinates:
        if model.coordinates[name].locked or name in {c.dependent for c in model.couplers}:
            raise InputError(f"coordinate '{name}' is locked or follows another", where)
    sharing.check(coordinates)
    for values in (motion.q, motion.rates, motion.accelerations, *loads.values()):
        if len(values) != len(motion.time):
            raise InputError(f"{len(values)} rows for {len(motion.time)} times", "muscles")
    if not np.isfinite([motion.q, motion.rates, motion.accelerations]).all():
        raise InputError("a coordinate or its derivative is not finite", "muscles")
