"""One sample of a scene: inputs with errors, and the results as one array.

Errors are applied to the loaded case, in SI units and for a right knee. Only a varied modulus of
the insert needs a new preparation of the contact.

Each skin marker is displaced on its segment by an error that is constant over the frames. The rigid
fit of the displaced markers to the nominal ones is the error of the segment's pose (`method =
"segments"`), which a kinematic chain distributes over more segments.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import TkambError
from tkamb.geometry.frames import (
    KNEE_COORDINATES,
    MIRROR,
    Array,
    inverse,
    knee_coordinates,
    knee_pose,
    pose,
)
from tkamb.io.recordings.markers import fit_seen
from tkamb.io.recordings.recording_tables import MarkerSegmentTable
from tkamb.io.scene import Scene
from tkamb.io.scene.case import Case, load_case
from tkamb.knee.frame import FrameStart
from tkamb.knee.ligaments import DISTAL, PROXIMAL, Ligament
from tkamb.knee.load import LinkPoint
from tkamb.knee.muscles import Muscle, SagittalWrap
from tkamb.knee.wrap_object import WrapObject
from tkamb.run.muscles.shared_muscles import SharedMuscles
from tkamb.run.read_scene import SharedState, recording_of
from tkamb.run.recording import Recording
from tkamb.run.status import frame_status
from tkamb.run.tabulate import frame_row
from tkamb.studies.uncertainty.inputs import (
    COP_AXES,
    GROUP_ENDS,
    LINE_ENDS,
    MARKED,
    PATELLAR_LIGAMENT,
    UNITS,
    Draw,
    Point,
    VariedInput,
    correlation_root,
    noise_of_point,
    pose_names,
    uncertainty_of,
    varied_inputs,
)
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.io.recordings.ground_reaction import GroundReaction
    from tkamb.io.recordings.motion import KneeMotion
    from tkamb.io.recordings.tibia import BodyMotion
    from tkamb.knee.patella_frame import HeadShare


def varied_case(case: Case, draw: Draw) -> Case:
    """Return the case with varied inputs. Velocities and accelerations are those of the recording.

    A case contains neither the insert's modulus nor the shared muscles. `Sampler` varies these.
    """
    tibia, coordinates = displaced_by_markers(case, draw)
    varied = replace(case, tibia=tibia, motion=replace(case.motion, coordinates=coordinates))
    changes: dict[str, Any] = {"motion": _motion(varied, draw), "scene": _scene(case, draw)}
    if tibia is not None:
        changes["tibia"] = replace(tibia, pose=tibia.pose @ _shank_error(case, draw))
    if case.ground is not None:
        changes["ground"] = _ground(case.ground, draw)
    changes["chain"] = case.chain.changed(
        draw.factor("segment_mass"),
        draw.place("insert_placement"),
        Rotation.from_rotvec(draw.turn("insert_placement")).as_matrix(),
    )
    changes["ligaments"] = tuple(_ligament(case, bundle, draw) for bundle in case.ligaments)
    changes["muscles"] = tuple(_muscle(case, muscle, draw) for muscle in case.muscles)
    changes["patella_heads"] = tuple(_head(case, head, draw) for head in case.patella_heads)
    changes["patella_ligaments"] = tuple(
        _strand(_ligament(case, bundle, draw), case, draw) for bundle in case.patella_ligaments
    )
    if case.patellar_ligament is not None:
        end = case.patellar_ligament.distal
        distal = LinkPoint(end.link, end.position + draw.place("tuberosity"))
        wrap = _wrap(case.patellar_ligament.wrap, PATELLAR_LIGAMENT, draw)
        changes["patellar_ligament"] = replace(case.patellar_ligament, distal=distal, wrap=wrap)
    return replace(case, **changes)


def _shank_error(case: Case, draw: Draw) -> Array:
    """Return the pose (4, 4) of the erroneous shank in the nominal one: it turns about AP through
    the insert's origin, and moves.
    """
    tilt, centre = draw.error("frontal_alignment"), case.chain.insert_in_tibia[:3, 3]
    rotation = Rotation.from_rotvec([tilt, 0.0, 0.0]).as_matrix()
    return pose(rotation, centre - rotation @ centre + draw.place("knee_centre"))


def _scene(case: Case, draw: Draw) -> Scene:
    scene = case.scene
    if scene.contact is None:
        return scene
    friction = max(0.0, scene.contact.friction + draw.error("friction"))
    limit = {"yield_stress_MPa": scene.yield_stress_MPa * draw.factor("yield_stress")}
    changes: dict[str, Any] = {
        "contact": scene.contact.model_copy(update={"friction": friction}),
        "output": scene.output.model_copy(update=limit),
    }
    if scene.material is not None:
        changes["material"] = scene.material.model_copy(update=limit)
    return scene.model_copy(update=changes)


def _ground(ground: "GroundReaction", draw: Draw) -> "GroundReaction":
    shift = np.zeros(3)
    for name, axis in COP_AXES.items():
        shift[axis] = draw.error(f"centre_of_pressure_{name}")
    factor = draw.factor("ground_reaction")
    return replace(
        ground,
        force=ground.force * factor,
        moment=ground.moment * factor,
        point=ground.point + shift,
    )


def _motion(case: Case, draw: Draw) -> "KneeMotion":
    motion, errors = case.motion, draw.standardised()
    coordinates = motion.coordinates.copy()
    for i, varied in enumerate(draw.inputs):
        if varied.name in KNEE_COORDINATES:
            scale = varied.deviation * UNITS[varied.unit]
            coordinates[:, KNEE_COORDINATES.index(varied.name)] += scale * errors[:, i]
    patella = motion.patella
    if patella is not None:
        patella = patella + np.array([draw.error("dome.ap"), draw.error("dome.si"), 0.0])
    return replace(motion, coordinates=coordinates, patella=patella)


def _ligament(case: Case, bundle: Ligament, draw: Draw) -> Ligament:
    strain = draw.error(f"ligament_strain.{bundle.name}")
    return replace(
        bundle,
        proximal=_on_femur(case, bundle.proximal, draw),
        distal=_on_femur(case, bundle.distal, draw),
        law=bundle.law.stiffened(draw.factor(f"ligament_stiffness.{bundle.name}")),
        # either the slack length or the reference strain is NaN and remains NaN
        slack_length=bundle.slack_length / (1.0 + strain),
        reference_strain=bundle.reference_strain + strain,
        wraps=tuple(_wrap_on_femur(case, wrap, draw) for wrap in bundle.wraps),
    )


def _strand(bundle: Ligament, case: Case, draw: Draw) -> Ligament:
    ends: dict[str, Any] = {end: getattr(bundle, end) for end in (PROXIMAL, DISTAL)}
    for name, point in ends.items():
        if case.chain.carrier(point.link) == "tibia":
            ends[name] = LinkPoint(point.link, point.position + draw.place("tuberosity"))
    return replace(bundle, **ends)


def _head(case: Case, head: "HeadShare", draw: Draw) -> "HeadShare":
    (line,) = case.muscles
    shifts = [draw.place(f"muscle_attachment.{line.name}.{end}") for end in LINE_ENDS]
    origin, insertion = _on_femur(case, head.origin, draw), head.insertion
    return replace(
        head,
        origin=LinkPoint(origin.link, origin.position + shifts[0]),
        insertion=LinkPoint(insertion.link, insertion.position + shifts[1]),
    )


def _muscle(case: Case, muscle: Muscle, draw: Draw) -> Muscle:
    points = [_on_femur(case, point, draw) for point in muscle.points]
    for k, end in zip((0, -1), LINE_ENDS, strict=True):
        shift = draw.place(f"muscle_attachment.{muscle.name}.{end}")
        points[k] = LinkPoint(points[k].link, points[k].position + shift)
    return replace(muscle, points=tuple(points), wrap=_wrap(muscle.wrap, muscle.name, draw))


def _wrap(wrap: SagittalWrap | None, name: str, draw: Draw) -> SagittalWrap | None:
    error = draw.error(f"tendon_band.{name}")
    return wrap if wrap is None or not error else replace(wrap, band=max(0.0, wrap.band + error))


def varied_muscles(muscles: SharedMuscles | None, draw: Draw) -> SharedMuscles | None:
    """Return shared muscles with varied strengths and attachments of their groups.

    Their motion and their moment arms at hip and ankle stay nominal.
    """
    if muscles is None:
        return None
    names = muscles.trial.muscles
    factors, shifts = np.ones(len(names)), np.zeros((len(GROUP_ENDS), len(names), 3))
    for group, members in muscles.groups.items():
        in_group = np.isin(names, members)
        factors[in_group] = draw.factor(f"muscle_strength.{group}")
        for shift, end in zip(shifts, GROUP_ENDS, strict=True):
            shift[in_group] = draw.place(f"muscle_attachment.{group}.{end}")
    return muscles.changed(factors, *shifts)


def _on_femur(case: Case, end: LinkPoint, draw: Draw) -> LinkPoint:
    """Return a point, moved with the femoral component if it is on the femur."""
    shift = draw.place("femoral_placement")
    if not shift.any() or case.chain.carrier(end.link) != "femur":
        return end
    shift_in_femur = case.chain.link_in(end.link, "femur")[:3, :3].T @ shift
    return LinkPoint(end.link, end.position + shift_in_femur)


def _wrap_on_femur(case: Case, wrap: WrapObject, draw: Draw) -> WrapObject:
    """Return a ligament's surface, moved as `_on_femur` moves its centre."""
    centre = _on_femur(case, LinkPoint(wrap.body, wrap.pose[:3, 3]), draw).position
    return replace(wrap, pose=pose(wrap.pose[:3, :3], centre))


def thinnable(case: Case) -> bool:
    """Return whether each frame can be computed without the other frames of the motion.

    A solved patella needs them for its derivatives, a reference strain for its frame.
    """
    solved = case.scene.patella is not None and case.scene.patella.motion == "solved"
    bundles = (*case.ligaments, *case.patella_ligaments)
    return not solved and all(np.isfinite(bundle.slack_length) for bundle in bundles)


def thinned(case: Case, frames: range) -> Case:
    """Return the case with only the given frames of its motion."""
    count, chosen = len(case.motion.time), list(frames)

    def at_frames(recording: Any) -> Any:
        if recording is None:
            return None
        values = {field.name: getattr(recording, field.name) for field in fields(recording)}
        series = {
            name: value[chosen]
            for name, value in values.items()
            if isinstance(value, np.ndarray) and len(value) == count
        }
        return replace(recording, **series)

    return replace(
        case,
        motion=at_frames(case.motion),
        tibia=at_frames(case.tibia),
        ground=at_frames(case.ground),
    )


def displaced_by_markers(case: Case, draw: Draw) -> "tuple[BodyMotion | None, Array]":
    """Return shank motion and knee coordinates (f, 6) with the errors of markers, as far as these
    give them.
    """
    markers, tibia, coordinates = case.scene.motion.markers, case.tibia, case.motion.coordinates
    if (
        markers is None
        or tibia is None
        or not any(varied.name.startswith("marker.") for varied in draw.inputs)
    ):
        return tibia, coordinates
    tables = {segment.name: segment for segment in markers.segment}
    is_left = case.scene.patient.side == "left"
    shank, thigh = (_fit_error(tables[name], draw, is_left) for name in MARKED)
    insert, knee = case.chain.insert_in_tibia, knee_pose(coordinates)
    thigh_pose = inverse(shank @ insert) @ insert @ knee @ thigh
    change = knee_coordinates(thigh_pose) - knee_coordinates(knee)
    varied = coordinates.copy()
    columns = [KNEE_COORDINATES.index(name) for name in markers.coordinates]
    varied[:, columns] += change[:, columns]
    return replace(tibia, pose=tibia.pose @ shank), varied


def _fit_error(segment: MarkerSegmentTable, draw: Draw, is_left: bool) -> Array:
    """Return the pose (4, 4) of the fitted segment in the nominal one, mirrored to a right leg."""
    points = np.array(list(segment.markers_mm.values())) * MILLIMETRE
    points = points @ MIRROR if is_left else points
    errors = np.array([draw.place(f"marker.{label}") for label in segment.markers_mm])
    weights = np.array([segment.weights.get(label, 1.0) for label in segment.markers_mm])
    poses, _ = fit_seen((points + errors)[None], points, weights, segment.name)
    return np.asarray(poses[0])


@dataclass(frozen=True, eq=False)
class Sample:
    """Results of one sample.

    Args:
        values: values of the requested columns, (names, frames); NaN if a frame failed or has no
            value.
        problems: reason why each frame failed, "" if it did not, (frames,).
        errors: errors of the inputs in standard deviations, (frames, d).
    """

    values: Array
    problems: np.ndarray
    errors: Array

    @property
    def failed(self) -> np.ndarray:
        """Whether each frame failed, (frames,)."""
        return self.problems != ""


class Sampler:
    """Computes samples of one scene.

    Attributes:
        case: nominal case. It contains only the frames to compute if `thinnable` allows it.

    Raises:
        TkambError: the scene is invalid.
    """

    def __init__(self, scene: Scene, frames: range, names: Sequence[str]) -> None:
        whole = load_case(scene)
        self._time = whole.motion.time
        self._chosen, self.names = frames, list(names)
        self.case, self._frames = (
            (thinned(whole, frames), range(len(frames))) if thinnable(whole) else (whole, frames)
        )
        self.inputs: tuple[VariedInput, ...] = varied_inputs(self.case)
        self._root = correlation_root(
            uncertainty_of(self.case).correlation, [varied.name for varied in self.inputs]
        )
        self._split = self.case.split
        self._recording = recording_of(self.case)
        self._recording.method.prepare()

    def draw(self, point: Point) -> Draw:
        """Return the errors of the inputs at a point."""
        table = uncertainty_of(self.case)
        count = len(pose_names(self.inputs))  # the pose inputs come first
        # noise of all recorded frames, so that it does not depend on the requested frames
        per_frame = noise_of_point(point, range(count), self._time, table.correlation_s, table.seed)
        if len(self.case.motion.time) < len(self._time):
            per_frame = per_frame[list(self._chosen)]
        if point.noise_of is None:  # a screening varies correlated inputs one at a time
            return Draw(self.inputs, point.normal, per_frame, 1.0)
        noise = per_frame @ self._root[:count, :count].T
        return Draw(self.inputs, self._root @ point.normal, noise, table.constant_share)

    def __call__(self, number: int, point: Point) -> Sample:
        """Return the sample at a point, whatever its number. Each frame has a warm start from the
        preceding frame.
        """
        draw = self.draw(point)
        errors = draw.standardised()[list(self._frames)]
        values = np.full((len(self.names), len(self._frames)), np.nan)
        try:
            case = self._varied(draw)
            nominal = self._recording.method
            contact, cam = nominal.knee.contact, nominal.cam
            if contact is not None:
                table = case.scene.contact
                assert table is not None
                contact = contact.changed(table.friction, draw.factor("young_modulus"))
            recording = recording_of(
                case, self._shared(draw), contact=contact, split_sensitivity=False, cam=cam
            )
            recording.method.prepare()
        except TkambError as error:  # the varied inputs are invalid, so every frame fails
            return Sample(values, np.full(len(self._frames), str(error)), errors)
        problems: list[str] = []
        before: list[FrameStart] = []
        for column, k in enumerate(self._frames):
            row, problem = _frame(case, recording, k, before)
            problems.append(problem)
            if not problem:
                values[:, column] = [row.get(name, np.nan) for name in self.names]
        return Sample(values, np.array(problems), errors)

    def _shared(self, draw: Draw) -> SharedState:
        nominal = self._recording
        muscles, contact = varied_muscles(nominal.muscles, draw), nominal.knee.contact
        pair = None if contact is None else contact.pair
        return SharedState(pair, muscles, nominal.extensor, self._frames)

    def _varied(self, draw: Draw) -> Case:
        case = varied_case(self.case, draw)
        case.__dict__["split"] = self._split  # cached: the femoral component is the same
        return case


class BandWorker:
    """Computes samples in a worker. It can be prepared before the column names are known."""

    def __init__(self, scene: Scene, frames: range) -> None:
        self._scene, self._frames = scene, frames
        self._sampler: Sampler | None = None
        with suppress(TkambError):  # the nominal run reports the error
            self._sampler = Sampler(scene, frames, ())

    def __call__(self, number: int, job: tuple[Point, list[str]]) -> Sample:
        """Return the sample of a job: a point and the names of the columns."""
        point, names = job
        sampler = self._sampler or Sampler(self._scene, self._frames, names)
        sampler.names = names
        return sampler(number, point)


def _frame(
    case: Case, recording: Recording, k: int, before: list[FrameStart]
) -> tuple[dict[str, Any], str]:
    """Return frame k's row in results.csv, and the reason if it failed.

    `before`, the last two starts, is updated.
    """
    frame = recording.frame(k, before)
    before.append(frame.next)
    del before[:-2]
    row = frame_row(case, k, frame, {}, frame_status(case, k, frame))
    return row, "; ".join(frame.failures)
