"""Static optimisation for a leg with tkamb's knee in place of the OpenSim model's knee.

The OpenSim model provides the rows of hip, ankle and subtalar joint. In each frame the equations of
tkamb's knee provide the row of the knee: the moment, the moment arm of the extensor group and the
moment arms of the muscles that cross the knee (`tkamb.knee.crossing`). `LegRecording` names the
files of model, motion and ground reaction. `load_knee_trial` reads them.

Contact, ligaments, muscles, patellar ligament and the load from outside balance on the shank. Let
W be the wrench of all loads but contact, about a point at the height of the contact. With the
condyles' contact points at z_m and z_l, superior-inferior force and frontal moment give

    N_m + N_l = W_y,    z_m N_m + z_l N_l = -W_x,   W_x: moment about AP.

W is affine in the forces of the muscles, and so are N_m and N_l. A static optimisation that knows
only the flexion moment lets a condyle lift off as soon as the load from outside allows it. Measured
knees do not: the medial condyle carries 60 to 80 % of the load in walking (PMC2965044, with
references). With a least share s of each condyle, the optimisation has two more rows,

    N_side - s (N_m + N_l) >= 0.

Reference: Winby et al., J Biomech 42:2294 (2009), doi:10.1016/j.jbiomech.2009.06.019 (muscles, not
ligaments, keep the lateral condyle loaded in walking).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import SIDES, Array, inverse, knee_coordinates, transform
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
from tkamb.knee.crossing import CrossingLines, tension_by_ligament
from tkamb.knee.equations import KneeGeometry
from tkamb.knee.load import PointForces, wrench_of
from tkamb.knee.released_forces import external_wrench, patellar_line
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
class CondyleRows:
    """The normal forces of the medial and the lateral condyle, affine in the muscle forces.

    Args:
        constant: forces without muscles, N, (2,).
        extensor: change per newton of the extensor group, (2,).
        arms: change per newton of the crossing muscles, (2, c).
    """

    constant: Array
    extensor: Array
    arms: Array

    def above_share(self, share: float) -> "CondyleRows":
        """Return N_side - share (N_m + N_l) for both sides."""
        change = np.eye(2) - share
        return CondyleRows(change @ self.constant, change @ self.extensor, change @ self.arms)


def condyle_rows(
    geometry: KneeGeometry, lines: CrossingLines, points: Mapping[str, Array]
) -> CondyleRows | None:
    """Return the condyles' normal forces; None: no condyle in contact, or no patella found.

    A condyle off the insert gets the other's contact point, mirrored about the femoral component's
    centre.

    Args:
        geometry: the frame with an extensor mechanism; its contact and muscle forces are not used.
        points: side -> contact point (3,), m, insert frame, for each condyle in contact.
    """
    if not points or geometry.extensor is None:
        return None
    try:
        ratio, constant = tension_by_ligament(geometry)
    except ComputationError:
        return None
    state, chain = geometry.state, geometry.state.chain
    coordinates = knee_coordinates(state.pose("femur"))
    known = external_wrench(geometry, coordinates)
    for load in (*geometry.ligaments, *geometry.post):
        if chain.on_shank(load.link):
            known = known + _wrench(load)
    # the extensor group of tension Q pulls the patellar ligament with (Q - constant) / ratio
    line = patellar_line(geometry, coordinates).wrench(state.pose("femur"))
    known = known - constant / ratio * line
    pulls = lines.unit_wrenches(state.pose("tibia"), state.pose("femur"))
    split = _split(points, float(coordinates[2]))
    return CondyleRows(split @ known, split @ line / ratio, split @ pulls.T)


def _wrench(load: PointForces) -> Array:
    total = np.asarray(wrench_of(load.points, load.forces).sum(axis=0))
    total[3:] += load.moment
    return total


def _split(points: Mapping[str, Array], centre: float) -> Array:
    """Return (2, 6) from W about the insert's origin to N of both sides."""
    height = float(np.mean([point[1] for point in points.values()]))
    one, other = SIDES
    z = {side: float(point[2]) for side, point in points.items()}
    z_m, z_l = (z.get(a, 2.0 * centre - z.get(b, 0.0)) for a, b in ((one, other), (other, one)))
    along = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    about = np.array([0.0, 0.0, -height, 1.0, 0.0, 0.0])
    return np.array([z_l * along + about, -z_m * along - about]) / (z_l - z_m)


@dataclass(frozen=True, eq=False)
class KneeTrial:
    """The problems of all frames, and the muscle lines across the knee.

    Args:
        problems: problems of all frames. Their row of the knee's flexion is not used.
        flexion: index of the knee's flexion among the coordinates.
        extensor: mask of the muscles of the extensor group, (m,).
        crossing: indices of the other muscles that cross the knee, (c,).
        shank: points where the crossing muscles leave shank or foot, tibia link, m, (f, c, 3).
        thigh: points where these muscles reach thigh or pelvis, femur link, m, (f, c, 3).
        groups: group -> names of its muscles, see `muscle_groups`.
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
        """Return the problem of frame k with the knee's row, and `FrameProblems.solved`.

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
        """Return the changes (2, m) of the condyles' loads per newton."""
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
    """Return the muscles across the knee, and their ends on shank and thigh."""
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
    """Files and options of a leg and its muscles.

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
    """Return the muscle groups of a leg, see `muscle_groups`."""
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
