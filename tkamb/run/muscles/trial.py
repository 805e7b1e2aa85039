"""Muscle forces of a whole recording by inverse dynamics and static optimisation.

In each frame,

    τ_c = Σ_i R_ci (a_i F_i + P_i) + r_c.

τ are the generalised forces of the motion (inertia, gravity, external loads), and R = -dL/dq the
moment arms of the muscle lines about the balanced coordinates c. F_i is a muscle's force at full
activation, and P_i its passive force. The reserve r_c is the moment that the muscles lack.
Activations a and reserves minimise, with w, p and the reserve sizes ρ of `Sharing`,

    Σ_i w_i a_i^p + Σ_c (r_c / ρ_c)²,   lowest <= a_i <= highest.

By the chain rule, a dependent coordinate contributes to τ and R of its coupler's independent
coordinate.

A taut muscle line is a chain of straight parts between points on bones and on their wrap objects.
A part from bone A at p to bone B at q pulls A at p along u = (q - p)/|q - p|, and B at q along -u.
The ends of the parts that leave a bone are the effective attachments of the line. The virtual work
of the wrenches w on the bones gives the moment arm,

    Σ_bones J_boneᵀ w_bone = -dL/dq.

Two effects add to the moment arm. A wrap object that is displaced by a point inside it
(docs/opensim.md) pushes on its bone. Path points that move within their bone (quadriceps
of gait2392) do work without a wrench on any bone.
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
    """Effective attachments of muscles on a bone for pulls towards another bone.

    Args:
        points: attachments in the frame of the bone, m, (f, m, 3); NaN for a muscle without a
            straight part between the two bones.
        directions: unit vectors of the pulls, (f, m, 3).
    """

    points: Array
    directions: Array


@dataclass(frozen=True, eq=False)
class Bones:
    """The bones of a leg (femur, patella, tibia, foot) and their loads. The wrenches of the m
    `muscles` and b bones have the moment first.

    Args:
        poses: pose of each bone's first body in ground, (f, b, 4, 4).
        pulls: wrench of unit tension of each muscle on each bone, in ground about its origin,
            (f, m, b, 6).
        demand: wrench that the motion of each bone requires beyond gravity and external loads, in
            ground about its origin, N·m and N, (f, b, 6); see `required_wrenches`.
        crossings: straight parts between bones; index -1: a body outside the leg.
    """

    names: tuple[str, ...]
    muscles: tuple[str, ...]
    poses: Array
    pulls: Array
    demand: Array
    crossings: StraightParts

    def pull_on(self, bones: Sequence[str], seen_from: str) -> Array:
        """Return the wrench (f, m, 6) of unit tension of each muscle on some bones together.

        Moment (N·m per N) and force (N per N), in the frame of bone `seen_from` about its origin.
        """
        total = self.pulls[:, :, [self.index(name) for name in bones]].sum(axis=2)
        return self._seen(total, seen_from)

    def demand_of(self, bones: Sequence[str], seen_from: str) -> Array:
        """Return the wrench (f, 6) that the motion of some bones requires, like `pull_on`."""
        total = self.demand[:, [self.index(name) for name in bones]].sum(axis=1)
        return self._seen(total[:, None], seen_from)[:, 0]

    def attachments(self, bone: str, towards: str | None) -> Attachments:
        """Return the effective attachments for pulls towards another bone.

        Of several straight parts between the bones the last one counts; `pull_on` sums over all.

        Args:
            towards: other bone; None: any body outside the leg, such as the pelvis.
        """
        bone_index = self.index(bone)
        other_index = -1 if towards is None else self.index(towards)
        points = np.full((len(self.poses), len(self.muscles), 3), np.nan)
        directions = points.copy()
        for own, other in ((0, 1), (1, 0)):
            bodies = self.crossings.bodies
            part = self.crossings.chosen(
                np.flatnonzero((bodies[:, own] == bone_index) & (bodies[:, other] == other_index))
            )
            pose = self.poses[part.frame, bone_index]
            step = part.ends[:, other] - part.ends[:, own]
            step /= np.linalg.norm(step, axis=1, keepdims=True)
            arm = part.ends[:, own] - pose[:, :3, 3]
            where = part.frame, part.line
            points[where] = np.einsum("pji,pj->pi", pose[:, :3, :3], arm)
            directions[where] = np.einsum("pji,pj->pi", pose[:, :3, :3], step)
        return Attachments(points, directions)

    def index(self, name: str) -> int:
        """Return the index of a bone."""
        if name not in self.names:
            raise InputError(f"no bone '{name}'", "muscles", names_near(name, self.names))
        return self.names.index(name)

    def _seen(self, wrench: Array, bone: str) -> Array:
        """Transform wrenches (f, k, 6) from ground to a bone's frame."""
        pose = self.poses[:, self.index(bone)]
        moment = wrench[..., :3] - np.cross(pose[:, None, :3, 3], wrench[..., 3:])
        rotation = pose[:, :3, :3]
        return np.concatenate([moment @ rotation, wrench[..., 3:] @ rotation], axis=-1)


@dataclass(frozen=True, eq=False)
class MuscleTrial:
    """Muscle forces of a recording; NaN in failed frames.

    Args:
        time: times, s, (f,).
        muscles: names of the m muscles.
        coordinates: names of the c balanced coordinates.
        activation: activations, (f, m).
        force_N: muscle forces, N, (f, m).
        moment_arm_m: moment arms -dL/dq, m per rad, (f, m, c).
        moment: moments τ of muscles and reserves together, N·m, (f, c).
        reserve: reserves r, N·m, (f, c).
        kkt_residual: relative violation of the optimality conditions, (f,).
        status: "ok" or "failed: …" for each frame.
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
        """Return the wrench (f, 6) of all muscles on some bones together.

        Moment (N·m) and force (N), in the frame of bone `seen_from` about its origin. On tibia and
        foot together, only muscles that cross the knee contribute.
        """
        pull = self.bones.pull_on(bones, seen_from)
        return np.einsum("fm,fmi->fi", self.force_N, pull)

    def knee_reaction(self) -> Array:
        """Return the wrench (f, 6) of the femur on the tibia without the muscles, mainly contact.

        Moment (N·m) and force (N), in the tibia's frame about its origin. It is the wrench that the
        motion of tibia and foot requires, minus gravity, external loads and muscles.

        Raises:
            InputError: muscles end on the patella, and the force of the patellar ligament is
                unknown.
        """
        shank = ("tibia", "foot")
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
                    f"{', '.join(names)} end on the patella; the force of the patellar ligament on "
                    "the tibia is unknown",
                    "muscles",
                    "use a model with quadriceps lines past the patella to the tibia",
                )
        return self.bones.demand_of(shank, "tibia") - self.muscle_wrench(shank, "tibia")


def solve_trial(
    model: OpenSimModel,
    motion: CoordinateMotion,
    loads: Mapping[str, Array],
    side: str = "right",
    sharing: Sharing | None = None,
) -> MuscleTrial:
    """Return the muscle forces of a leg in every frame of a motion.

    Args:
        motion: coordinates of the model over time, including locked ones.
        loads: name of a body -> external wrench on it, moment (N·m) first, force (N), in ground
            about its origin, (f, 6), such as the ground reaction on each foot. A frame with NaN
            fails.
        side: "right" or "left".
        sharing: options; None: `Sharing()`.

    Raises:
        InputError: no such side, muscle, coordinate or body, or an option is out of range.
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
    """Return the problems of all frames, and the bones with their loads.

    Args:
        loads: body -> external wrench, see `solve_trial`.
    """
    model, kinematics = leg.model, Kinematics(leg.model)
    names = leg_muscles(leg) if sharing.muscles is None else sharing.muscles
    balanced = leg_coordinates(leg) if sharing.coordinates is None else sharing.coordinates
    _check(kinematics, motion, loads, names, balanced, sharing)
    q, groups = motion.q, leg_bones(leg)
    bones = kinematics.motion(q)
    needed = required_wrenches(kinematics, bones, q, motion.rates, motion.accelerations, loads)
    coupling = kinematics.coupling(q)[:, :, [kinematics.coordinates[name] for name in balanced]]
    moment = np.einsum("fbin,fbi,fnc->fc", bones.twists, needed, coupling, optimize=True)
    pulls = LineSet(kinematics, names).pulls(q, list(groups.values()))
    arms = pulls.moment_arms @ coupling
    active, passive = _strength(kinematics, motion, sharing, pulls)
    muscles = [model.muscles[name] for name in names]
    problem = FrameProblems(muscles, balanced, sharing, moment, arms, active, passive)
    return problem, _bones(groups, bones, needed, pulls)


def _bones(
    groups: Mapping[str, Sequence[str]], bones: Motion, needed: Array, pulls: Pulls
) -> Bones:
    places = [[bones.bodies[name] for name in bodies] for bodies in groups.values()]
    demand = np.stack([needed[:, place].sum(axis=1) for place in places], axis=1)
    poses = bones.poses[:, [place[0] for place in places]]
    return Bones(tuple(groups), pulls.names, poses, pulls.wrenches, demand, pulls.crossings)


def _strength(
    kinematics: Kinematics, motion: CoordinateMotion, sharing: Sharing, pulls: Pulls
) -> tuple[Array, Array]:
    """Return active forces at full activation and passive forces (f, m), N."""
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
