"""The muscles of a scene with [muscles]: shared frame by frame, in agreement with the knee.

Hip, ankle and subtalar rows of the static optimisation are the OpenSim model's, made once for all
frames. The flexion row is the knee's own (`tkamb.knee.crossing`), so that the tension of
the extensor group which the optimisation finds is the one that the knee's equations give back.
"""

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
from tkamb.run.muscles.knee_trial import KneeTrial, LegRecording, group_names, load_knee_trial
from tkamb.run.muscles.sharing import EmgGuide, Sharing
from tkamb.units import MILLIMETRE


@dataclass(frozen=True)
class SharedMuscleSettings:
    """Muscles shared between the joints of a leg."""

    max_offset: float = 0.5 * MILLIMETRE
    """m; how far the insert and the hip of the URDF may lie from those of the muscle model. Chosen:
    rounding of the two files is smaller."""
    max_iterations: int = 8
    """Iterations between muscle forces and the lines that they turn; what is open afterwards is
    reported. Chosen: frames that converge need fewer."""


SHARED_MUSCLES = SharedMuscleSettings()


class SharedMuscles:
    """Shares the load of frames among the muscles of a leg.

    Args:
        trial: the muscles over the frames.
        is_left: whether it is a left leg, whose knee is computed as its mirror image.

    Attributes:
        trial: as given.
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
        """Group of muscles -> their names (`tkamb.run.muscles.leg.muscle_groups`)."""
        return dict(self.trial.groups)

    def changed(self, strength: Array, shank: Array, thigh: Array) -> "SharedMuscles":
        """Return the muscles with other strengths, and their lines across the knee elsewhere.

        Args:
            strength: (m,) factors of each muscle's strength.
            shank: (m, 3) m, shifts of where its line leaves the shank, a right leg's tibia link.
            thigh: (m, 3) m, of where it reaches the thigh, femur link.
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
    """Shares the load of one frame among the muscles of a leg.

    Args:
        trial: the muscles over the frames.
        k: frame.
        lines: theirs across the knee.
    """

    trial: KneeTrial
    k: int
    lines: CrossingLines

    def share(self, geometry: KneeGeometry, friction: float, lifted: frozenset[str]) -> MuscleShare:
        """Return what each muscle carries with the knee as it stands.

        Args:
            geometry: the knee, with contact points where contact is modelled.
            friction: Coulomb coefficient.
            lifted: sides that carry nothing.
        """
        try:
            return self._shared(flexion_row(geometry, self.lines, friction, lifted))
        except ComputationError as error:
            return self._failed(f"failed: {error.what}")

    def share_of_yielding_knee(
        self, geometry: KneeGeometry, base: float, per_wrench: Array
    ) -> MuscleShare:
        """Return what each muscle carries while released coordinates yield to it.

        Args:
            geometry: the knee; its contact is not looked at.
            base: N, see `yielding_flexion_row`.
            per_wrench: (6,), likewise.
        """
        try:
            row = yielding_flexion_row(geometry, self.lines, base, per_wrench)
        except ComputationError as error:
            return self._failed(f"failed: {error.what}")
        return self._shared(row)

    def at(self, share: MuscleShare) -> MuscleShare:
        """Return the forces of a share along the lines of this frame."""
        return replace(share, lines=self.lines)

    def tension(self, share: MuscleShare) -> float:
        """Return the tension of the extensor group, N."""
        return float(share.force[self.trial.extensor].sum())

    def solve(self, geometry: KneeGeometry, friction: float) -> tuple[KneeGeometry, SolvedLoads]:
        """Return the geometry with the muscles' forces in it, and all loads.

        Contact points and lines stay, so the sharing is exact at once; again where a condyle
        turns out to carry nothing.
        """
        lifted = geometry.lifted
        for _ in range(SHARED_MUSCLES.max_iterations):
            share = self.share(geometry, friction, lifted)
            geometry = replace(geometry, share=share)
            if share.status != "ok":
                return geometry, unsolved([f"muscles: {share.status.removeprefix('failed: ')}"])
            loads = solve_knee(geometry, friction)
            if loads.problems or loads.lifted == lifted:
                return geometry, loads
            lifted = loads.lifted
        return geometry, unsolved(["the iteration of muscles and load state does not converge"])

    def _shared(self, row: FlexionRow) -> MuscleShare:
        trial, k = self.trial, self.k
        problem, (activation, reserve, _, status) = trial.solved(
            k, row.moment, row.extensor_arm, row.arms
        )
        if status != "ok":
            return self._failed(status)
        force = trial.force(k, activation)
        return self._share(activation, force, problem.moment[0], reserve, "ok")

    def _failed(self, status: str) -> MuscleShare:
        nothing = np.full(len(self.trial.muscles), np.nan)
        rest = np.full(len(self.trial.problems.coordinates), np.nan)
        return self._share(nothing, nothing, rest, rest, status)

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
    """Return the options of a scene's [muscles]."""
    return Sharing(
        reserve=table.reserve_Nm,
        exponent=table.exponent,
        weights=table.weights,
        lowest=table.least_activation,
        law=table.law,
    )


def load_muscles(case: Case) -> SharedMuscles:
    """Return the muscles of a case with [muscles], checked against its URDF.

    Raises:
        InputError: files that cannot be used, or a model that is not the URDF's.
    """
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
    )
    links, trial = load_knee_trial(source, case.motion.time)
    _check_links(case, links.insert_in_tibia, links.hip)
    if table.emg is not None:
        trial = _guided(case, trial)
    return SharedMuscles(trial, scene.patient.side == "left")


def groups_of(case: Case) -> tuple[str, ...]:
    """Return the names of the groups of the muscles of a case with [muscles].

    Raises:
        InputError: a model that cannot be used.
    """
    table = case.scene.muscles
    assert table is not None
    return group_names(table.model, case.scene.patient.side)


def _guided(case: Case, trial: KneeTrial) -> KneeTrial:
    """Return the trial with the scene's EMG in it, where it is more than reported.

    Raises:
        InputError: a muscle that the model does not have, or frames without EMG.
    """
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
                f"covers {envelopes.time[0]:g} to {envelopes.time[-1]:g} s, the frames "
                f"{time[0]:g} to {time[-1]:g} s",
                envelopes.path,
                "EMG that guides the muscles is needed in every frame",
            )
    size = table.emg.weight if table.emg.use == "target" else table.emg.width
    assert size is not None
    guide = EmgGuide(values, table.emg.use, size)
    return replace(trial, problems=replace(trial.problems, guide=guide))


def _check_links(case: Case, insert_in_tibia: Array, hip: Array) -> None:
    """Raise unless the model's insert and hip lie where the URDF has them."""
    is_left, table = case.scene.patient.side == "left", case.scene.muscles
    assert table is not None
    insert = mirrored_pose(insert_in_tibia) if is_left else insert_in_tibia
    centre = MIRROR @ hip if is_left else hip
    for name, ours, theirs in (
        ("insert", insert[:3, 3], case.chain.insert_in_tibia[:3, 3]),
        ("hip", centre, case.chain.link_in("hip", "femur")[:3, 3]),
    ):
        apart = float(np.linalg.norm(ours - theirs))
        if apart > SHARED_MUSCLES.max_offset:
            raise InputError(
                f"has its {name} {apart / MILLIMETRE:.1f} mm from where the URDF has it",
                table.model,
                "make the URDF from this model with `tkamb import`",
            )
