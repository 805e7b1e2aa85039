"""The muscles of a scene with [muscles]: static optimisation in each frame.

The OpenSim model provides the rows of hip, ankle and subtalar joint, the equations of the knee that
of its flexion (`tkamb.knee.crossing`). The tension of the extensor group is therefore the same in
both.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from tkamb.errors import ComputationError, InputError, names_near
from tkamb.geometry.frames import MIRROR, Array, mirrored_pose
from tkamb.io.scene.case import Case
from tkamb.io.scene.tables import MusclesTable
from tkamb.knee.crossing import (
    CrossingLines,
    FlexionRow,
    MuscleShare,
    flexion_row,
    yielding_flexion_row,
)
from tkamb.knee.equations import KneeGeometry, SolvedLoads, solve_knee, unsolved
from tkamb.run.muscles.knee_trial import (
    KneeTrial,
    LegRecording,
    condyle_rows,
    group_names,
    load_knee_trial,
)
from tkamb.run.muscles.sharing import EmgGuide, Sharing
from tkamb.units import MILLIMETRE

# m: largest distance of insert and hip between URDF and muscle model. The rounding of the two
# files is smaller.
MAX_OFFSET = 0.5 * MILLIMETRE
# 1: largest number of iterations, each with muscle forces for the condyles lifted so far. A frame
# that needs more fails. Not studied.
MAX_ITERATIONS = 8


class SharedMuscles:
    """The muscles of a leg in all frames.

    Args:
        is_left: whether the leg is a left one, whose knee is computed as its mirror image.
    """

    def __init__(self, trial: KneeTrial, is_left: bool = False) -> None:
        flip = MIRROR if is_left else np.eye(3)
        self.trial, self._left = trial, is_left
        self._shank, self._thigh = trial.shank @ flip, trial.thigh @ flip
        self._knee = trial.knee
        if is_left and trial.knee is not None:
            self._knee = mirrored_pose(trial.knee)

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """Name of a group -> names of its muscles (`tkamb.run.muscles.leg.muscle_groups`)."""
        return dict(self.trial.groups)

    def changed(self, strength: Array, shank: Array, thigh: Array) -> "SharedMuscles":
        """Return the muscles with changed strengths and shifted lines across the knee.

        Args:
            strength: factors of the muscles' strength, (m,).
            shank: shifts of the points where lines leave the shank, m, (m, 3), in the axes of the
                tibia link of a right leg.
            thigh: shifts of the points where lines reach the thigh, m, (m, 3), in the axes of the
                femur link of a right leg.
        """
        flip = MIRROR if self._left else np.eye(3)
        trial = self.trial.changed(strength, shank @ flip, thigh @ flip)
        return SharedMuscles(trial, self._left)

    def frame(self, k: int) -> "FrameMuscles":
        """Return the muscles at frame k."""
        knee = None if self._knee is None else self._knee[k]
        return FrameMuscles(self.trial, k, CrossingLines(self._shank[k], self._thigh[k], knee))


@dataclass(frozen=True, eq=False)
class FrameMuscles:
    """The muscles of a leg in one frame.

    Args:
    lines: muscle lines across the knee in this frame of the `trial`.
    """

    trial: KneeTrial
    k: int
    lines: CrossingLines

    def share(self, geometry: KneeGeometry, friction: float, lifted: frozenset[str]) -> MuscleShare:
        """Return the force of each muscle at fixed pose and contact points.

        Args:
            geometry: geometry of the knee, with contact points if contact is modelled.
            lifted: sides without contact force.
        """
        try:
            row = flexion_row(geometry, self.lines, friction, lifted)
            points = {side: one.point for side, one in geometry.condyles.items()}
            share = self._shared(row, geometry, points if len(points) == 2 and not lifted else {})
        except ComputationError as error:
            return self._failed(f"failed: {error.what}")
        if lifted > geometry.lifted and self.trial.problems.sharing.least_share > 0.0:
            return replace(share, both_loaded=False)
        return share

    def share_of_yielding_knee(
        self,
        geometry: KneeGeometry,
        base: float,
        per_wrench: Array,
        points: Mapping[str, Array] | None = None,
    ) -> MuscleShare:
        """Return the force of each muscle if the knee's released coordinates depend on the forces.

        Args:
            geometry: geometry of the knee. Its contact is not used.
            base: tension of the patellar ligament, N, see `yielding_flexion_row`.
            per_wrench: change of this tension by a wrench on the insert, (6,).
            points: side -> contact point (3,), m, of each condyle in contact; None: unknown.
        """
        try:
            row = yielding_flexion_row(geometry, self.lines, base, per_wrench)
        except ComputationError as error:
            return self._failed(f"failed: {error.what}")
        return self._shared(row, geometry, points or {})

    def at(self, share: MuscleShare) -> MuscleShare:
        """Return muscle forces of another frame along the lines of this frame."""
        return replace(share, lines=self.lines)

    def tension(self, share: MuscleShare) -> float:
        """Return the tension of the extensor group, N."""
        return float(share.force[self.trial.extensor].sum())

    def solve(self, geometry: KneeGeometry, friction: float) -> tuple[KneeGeometry, SolvedLoads]:
        """Return the geometry with the muscle forces, and all loads.

        With fixed contact points and lines one pass is exact; it is repeated if a condyle lifts
        off.
        """
        lifted = geometry.lifted
        for _ in range(MAX_ITERATIONS):
            share = self.share(geometry, friction, lifted)
            geometry = replace(geometry, share=share)
            if share.status != "ok":
                return geometry, unsolved([f"muscles: {share.status.removeprefix('failed: ')}"])
            loads = solve_knee(geometry, friction)
            if loads.problems or loads.lifted == lifted:
                return geometry, loads
            lifted = loads.lifted
        return geometry, unsolved(["the iteration of muscles and load state does not converge"])

    def _shared(
        self, row: FlexionRow, geometry: KneeGeometry, points: Mapping[str, Array]
    ) -> MuscleShare:
        """Return the forces that keep the least share on each condyle or, if none do, all forces.

        `points` are the contact points of condyles, which alone must have it.
        """
        trial, k, required = self.trial, self.k, self.trial.problems.sharing.least_share
        rows = condyle_rows(geometry, self.lines, points) if required > 0.0 else None
        least = None if rows is None else rows.above_share(required)
        knee = (k, row.moment, row.extensor_arm, row.arms)
        problem, (activation, reserve, _, status) = trial.solved(*knee, least)
        both_loaded = status == "ok"
        if least is not None and not both_loaded:
            problem, (activation, reserve, _, status) = trial.solved(*knee)
        if status != "ok":
            return self._failed(status)
        force = trial.force(k, activation)
        share = self._share(activation, force, problem.moment[0], reserve, "ok")
        return replace(share, both_loaded=both_loaded)

    def _failed(self, status: str) -> MuscleShare:
        forces = np.full(len(self.trial.muscles), np.nan)
        moments = np.full(len(self.trial.problems.coordinates), np.nan)
        return self._share(forces, forces, moments, moments, status)

    def _share(
        self, activation: Array, force: Array, moment: Array, reserve: Array, status: str
    ) -> MuscleShare:
        trial = self.trial
        return MuscleShare(
            trial.muscles,
            activation,
            force,
            trial.problems.coordinates,
            moment,
            reserve,
            trial.flexion,
            trial.crossing,
            self.lines,
            status,
        )


def sharing_of(table: MusclesTable) -> Sharing:
    """Return the options of the static optimisation from [muscles]."""
    return Sharing(
        reserve=table.reserve_Nm,
        exponent=table.exponent,
        weights=table.weights,
        lowest=table.least_activation,
        least_share=table.least_condyle_share,
        law=table.law,
    )


def load_muscles(case: Case) -> SharedMuscles:
    """Return the muscles of a case with [muscles]."""
    scene, table = case.scene, case.scene.muscles
    assert table is not None
    ground, markers, insert = scene.ground_reaction, scene.motion.markers, scene.implant.insert
    if ground is not None and ground.applied == "ankle":
        raise InputError(
            "applied = 'ankle' leaves the ankle without its moment",
            "[ground_reaction] with [muscles]",
            "apply the force at the centre of pressure",
        )
    source = LegRecording(
        model=table.model,
        side=scene.patient.side,
        coordinates=table.coordinates,
        markers=scene.motion.file if markers else None,
        laboratory_axes=markers.laboratory_axes if markers else "+x,+y,+z",
        cutoff=scene.motion.cutoff_Hz,
        ground=ground,
        insert_placement=case.insert_placement,
        mesh_axes="+x,+y,+z" if insert is None else insert.axes,
        sharing=sharing_of(table),
        points={
            segment.name: {
                label: np.array(place) * MILLIMETRE for label, place in segment.markers_mm.items()
            }
            for segment in (markers.segment if markers else ())
        },
    )
    links, trial = load_knee_trial(source, case.motion.time)
    _check_links(case, links.insert_in_tibia, links.hip)
    if table.emg is not None:
        trial = _guided(case, trial)
    return SharedMuscles(trial, scene.patient.side == "left")


def groups_of(case: Case) -> tuple[str, ...]:
    """Return the muscle groups of a case with [muscles]."""
    table = case.scene.muscles
    assert table is not None
    return group_names(table.model, case.scene.patient.side)


def _guided(case: Case, trial: KneeTrial) -> KneeTrial:
    table, envelopes, time = case.scene.muscles, case.emg, case.motion.time
    assert table is not None and table.emg is not None and envelopes is not None
    for name in envelopes.channel_of:
        if name not in trial.muscles:
            hint = names_near(name, trial.muscles, "the leg's muscles")
            raise InputError(f"no muscle '{name}'", "[muscles.emg] channels", hint)
    if table.emg.use == "report":
        return trial
    values = np.full((len(time), len(trial.muscles)), np.nan)
    for name in envelopes.channel_of:
        values[:, trial.muscles.index(name)] = envelopes.at(name, time)
        if np.isnan(values[:, trial.muscles.index(name)]).any():
            raise InputError(
                f"covers {envelopes.time[0]:g} to {envelopes.time[-1]:g} s, but the frames "
                f"{time[0]:g} to {time[-1]:g} s",
                envelopes.path,
                "EMG that guides the muscles must cover every frame",
            )
    size = table.emg.weight if table.emg.use == "target" else table.emg.width
    assert size is not None
    guide = EmgGuide(values, table.emg.use, size)
    return replace(trial, problems=replace(trial.problems, guide=guide))


def _check_links(case: Case, insert_in_tibia: Array, hip: Array) -> None:
    is_left, table = case.scene.patient.side == "left", case.scene.muscles
    assert table is not None
    insert = mirrored_pose(insert_in_tibia) if is_left else insert_in_tibia
    centre = MIRROR @ hip if is_left else hip
    for name, ours, theirs in (
        ("insert", insert[:3, 3], case.chain.insert_in_tibia[:3, 3]),
        ("hip", centre, case.chain.link_in("hip", "femur")[:3, 3]),
    ):
        apart = float(np.linalg.norm(ours - theirs))
        if apart > MAX_OFFSET:
            raise InputError(
                f"has its {name} {apart / MILLIMETRE:.1f} mm away from the {name} of the URDF",
                table.model,
                "make the URDF from this model with `tkamb import`",
            )
