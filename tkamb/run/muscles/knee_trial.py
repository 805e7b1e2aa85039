"""Static optimisation for a leg with tkamb's knee in place of the OpenSim model's knee.

The OpenSim model provides the rows of hip, ankle and subtalar joint. In each frame the equations of
tkamb's knee provide the row of the knee: the moment, the moment arm of the extensor group and the
moment arms of the muscles that cross the knee (`tkamb.knee.crossing`). `LegRecording` names the
files of model, motion and ground reaction. `load_knee_trial` reads them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, inverse, transform
from tkamb.io.importing.anatomy import Leg, find_leg
from tkamb.io.importing.links import Links, find_links
from tkamb.io.importing.markers import placed_markers
from tkamb.io.importing.model_fit import fit_model
from tkamb.io.opensim.kinematics import Kinematics
from tkamb.io.opensim.motion import CoordinateMotion, coordinate_motion, read_coordinates
from tkamb.io.opensim.read import read_osim
from tkamb.io.recordings.filtering import Cutoff
from tkamb.io.recordings.ground_reaction import load_ground_reaction
from tkamb.io.recordings.recording_tables import GroundReactionTable, Side
from tkamb.io.recordings.tables import read_table
from tkamb.knee.condyle_rows import CondyleRows
from tkamb.run.muscles.leg import (
    default_reserves,
    foot_loads,
    leg_bones,
    leg_muscles,
    muscle_groups,
)
from tkamb.run.muscles.sharing import FrameProblems, Sharing
from tkamb.run.muscles.trial import Bones, trial_problems


@dataclass(frozen=True, eq=False)
class KneeTrial:
    """The optimisation problems of all frames, and the muscle lines across the knee.

    Args:
        problems: problems of all frames. Their row of the knee's flexion is not used.
        flexion: index of the knee's flexion among the coordinates.
        extensor: mask of the muscles of the extensor group, (m,).
        crossing: indices of the other muscles that cross the knee, (c,).
        shank: points where the crossing muscles leave shank or foot, tibia link, m, (f, c, 3).
        thigh: points where these muscles reach thigh or pelvis, femur link, m, (f, c, 3).
        groups: name of a group -> names of its muscles, see `muscle_groups`.
        knee: pose of the femur link in the tibia link for which the points were computed,
            (f, 4, 4); None: unknown.
    """

    problems: FrameProblems
    flexion: int
    extensor: np.ndarray
    crossing: np.ndarray
    shank: Array
    thigh: Array
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    knee: Array | None = None

    @property
    def muscles(self) -> tuple[str, ...]:
        """Names of the m muscles."""
        return tuple(muscle.name for muscle in self.problems.muscles)

    def changed(self, strength: Array, shank: Array, thigh: Array) -> "KneeTrial":
        """Return the trial with changed strengths and shifted lines across the knee.

        Args:
            strength: factors of the muscles' active and passive strength, (m,).
            shank: shifts of the points where lines leave the shank, m, (m, 3).
            thigh: shifts of the points where lines reach the thigh, m, (m, 3).
        """
        muscles = [
            replace(muscle, max_isometric_force_N=float(factor) * muscle.max_isometric_force_N)
            for muscle, factor in zip(self.problems.muscles, strength, strict=True)
        ]
        problems = replace(
            self.problems,
            muscles=muscles,
            active=self.problems.active * strength,
            passive=self.problems.passive * strength,
        )
        return replace(
            self,
            problems=problems,
            shank=self.shank + shank[self.crossing],
            thigh=self.thigh + thigh[self.crossing],
        )

    def solved(
        self,
        k: int,
        moment: float,
        extensor_arm: float,
        arms: Array,
        least: CondyleRows | None = None,
    ) -> tuple[FrameProblems, tuple[Array, Array, float, str]]:
        """Return the problem of frame k with the knee's row, and its solution.

        The solution has the form of `FrameProblems.solved`.

        Args:
            moment: moment of muscles and reserve at the knee, N·m.
            extensor_arm: moment arm of the extensor group, m.
            arms: moment arms of the crossing muscles, m, (c,).
            least: loads of the condyles that must not be negative; None: without.
        """
        problems, rows = self.problems, slice(k, k + 1)
        moments, table = problems.moment[rows].copy(), problems.arms[rows].copy()
        moments[0, self.flexion] = moment
        row = np.where(self.extensor, extensor_arm, 0.0)
        row[self.crossing] = arms
        # NaN of a muscle without a taut path remains, so that the status names this muscle
        missing = np.isnan(table[0]).any(axis=1)
        table[0, :, self.flexion] = np.where(missing, np.nan, row)
        guide = None if problems.guide is None else problems.guide.only(k)
        frame = replace(
            problems,
            moment=moments,
            arms=table,
            active=problems.active[rows],
            passive=problems.passive[rows],
            guide=guide,
            least=None if least is None else (least.constant, self._gain(least)),
        )
        return frame, frame.solved(0)

    def _gain(self, rows: CondyleRows) -> Array:
        """Return the changes (2, m) of the condyles' loads per newton of each muscle."""
        gain = np.where(self.extensor, rows.extensor[:, None], 0.0)
        gain[:, self.crossing] = rows.arms
        return gain

    def force(self, k: int, activation: Array) -> Array:
        """Return the muscle forces (m,), N, in frame k at activations (m,)."""
        return np.asarray(activation * self.problems.active[k] + self.problems.passive[k])


def knee_trial(
    links: Links, motion: CoordinateMotion, loads: Mapping[str, Array], sharing: Sharing
) -> KneeTrial:
    """Return the muscles of a leg over a motion, for tkamb's knee with its own patella.

    Args:
        motion: coordinates of the OpenSim model over time.
        loads: name of a body -> external wrenches, (f, 6), as in `solve_trial`.
    """
    leg = links.leg
    problems, bones = trial_problems(leg, motion, loads, sharing)
    if leg.flexion not in problems.coordinates:
        raise InputError("the knee's flexion is not balanced", leg.model.name)
    extensor = np.array(
        [leg.patella in [p.body for p in muscle.path.points] for muscle in problems.muscles]
    )
    if leg.patella is None or not extensor.any():
        raise InputError("no muscle leads to or past a patella", leg.model.name)
    crossing, shank, thigh = _crossing_lines(links, bones, extensor)
    flexion = problems.coordinates.index(leg.flexion)
    groups = muscle_groups(leg, problems.muscles)
    tibia, femur = (
        bones.poses[:, bones.index(bone)] @ own
        for bone, own in (("tibia", links.tibia), ("femur", links.femur))
    )
    knee = inverse(tibia) @ femur
    return KneeTrial(problems, flexion, extensor, crossing, shank, thigh, groups, knee)


def _crossing_lines(
    links: Links, bones: Bones, extensor: np.ndarray
) -> tuple[np.ndarray, Array, Array]:
    """Return the indices of the muscles across the knee, and their ends on shank and thigh."""
    parts = bones.crossings
    below = np.isin(parts.bodies, [bones.index("tibia"), bones.index("foot")])
    above = np.isin(parts.bodies, [bones.index("femur"), -1])
    across = (below[:, 0] & above[:, 1]) | (above[:, 0] & below[:, 1])
    chosen = np.flatnonzero(across & ~extensor[parts.line])
    part = parts.chosen(chosen)
    crossing = np.unique(part.line)
    frames = len(bones.poses)
    counts = np.zeros((frames, len(bones.muscles)), int)
    np.add.at(counts, (part.frame, part.line), 1)
    if (counts > 1).any():
        name = bones.muscles[int(np.argmax(counts.max(axis=0)))]
        raise InputError(f"'{name}' crosses the knee more than once", links.leg.model.name)
    ends = np.full((2, frames, len(crossing), 3), np.nan)
    column = np.searchsorted(crossing, part.line)
    rows = np.arange(len(chosen))
    first = np.where(below[chosen, 0], 0, 1)  # index of the end below the knee
    for side, end, bone, own in (
        (0, first, "tibia", links.tibia),
        (1, 1 - first, "femur", links.femur),
    ):
        pose = bones.poses[part.frame, bones.index(bone)] @ own
        ends[side, part.frame, column] = transform(inverse(pose), part.ends[rows, end][:, None])[
            :, 0
        ]
    return crossing, ends[0], ends[1]


@dataclass(frozen=True, eq=False)
class LegRecording:
    """The files and options from which a leg and its muscles are read.

    Args:
        coordinates: path of a .mot or .sto file of the model's coordinates; None: the coordinates
            are fitted to the markers.
        markers: path of a marker recording; None: no markers.
        laboratory_axes: laboratory axes that point forward, up and right.
        cutoff: cutoff frequency of the coordinates, Hz.
        ground: table of the ground reaction on the foot; None: no ground reaction.
        insert_placement: pose of the insert's mesh in the insert frame, (4, 4), see `find_links`;
            None: no implant.
        mesh_axes: axes of the mesh that point anterior, superior and right.
        points: segment -> label -> position of a marker, m, (3,), where it differs from the
            model's, see `placed_markers`.
    """

    model: Path
    side: Side
    coordinates: Path | None
    markers: Path | None
    laboratory_axes: str
    cutoff: Cutoff
    ground: GroundReactionTable | None
    insert_placement: Array | None
    mesh_axes: str
    sharing: Sharing
    points: Mapping[str, Mapping[str, Array]] = field(default_factory=dict)


def load_knee_trial(source: LegRecording, time: Array) -> tuple[Links, KneeTrial]:
    """Return the links of a leg in the bodies of its model, and the trial at some times.

    Args:
        time: times of the frames on the clock of the recordings, s, (f,).
    """
    leg = _read_leg(source.model, source.side)
    links = find_links(leg, source.insert_placement, source.mesh_axes, {}, False)
    motion = _motion(source, Kinematics(placed_markers(links, source.points)), time)
    loads = {}
    if source.ground is not None:
        # "right" means no mirroring: the model has the leg of the recorded side
        reaction = load_ground_reaction(source.ground, time, "right")
        loads = foot_loads(leg.model, {source.side: reaction})
    sharing = source.sharing
    if sharing.reserve is None:
        sharing = replace(sharing, reserve=default_reserves(leg))
    return links, knee_trial(links, motion, loads, sharing)


def group_names(model: Path, side: Side) -> tuple[str, ...]:
    """Return the names of the muscle groups of a leg, see `muscle_groups`."""
    leg = _read_leg(model, side)
    return tuple(muscle_groups(leg, [leg.model.muscles[name] for name in leg_muscles(leg)]))


def _read_leg(path: Path, side: Side) -> Leg:
    leg = find_leg(read_osim(path, partial=True), side)
    leg.model.check_gravity()
    bodies = {body for group in leg_bones(leg).values() for body in group}
    for one in leg.model.unread:
        if one.constrains or (one.concerns & bodies and one.kind != "Marker"):
            raise InputError(one.reason)
    return leg


def _motion(source: LegRecording, kinematics: Kinematics, time: Array) -> CoordinateMotion:
    if source.coordinates is not None:
        recorded = read_table(source.coordinates)
        q, _ = read_coordinates(kinematics, recorded)
        stamps = recorded.time()
    else:
        if source.markers is None:
            raise InputError("is missing", "[muscles] coordinates", "name a .mot or .sto file")
        recorded = read_table(source.markers)
        stamps = recorded.time()
        _, fit = fit_model(kinematics.model, recorded, laboratory_axes=source.laboratory_axes)
        if not fit.solved.all():
            raise InputError(
                f"the fit of the model to the markers fails in {int((~fit.solved).sum())} frames",
                source.markers,
                "give [muscles] coordinates",
            )
        q = fit.state
    if time[0] < stamps[0] - 1e-9 or time[-1] > stamps[-1] + 1e-9:
        raise InputError(
            f"covers {stamps[0]:g} to {stamps[-1]:g} s, but frames {time[0]:g} to {time[-1]:g} s",
            recorded.path,
        )
    return coordinate_motion(
        kinematics, stamps, np.asarray(q), source.cutoff, time, "coordinates of the model"
    )
