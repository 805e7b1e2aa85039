"""The computations of `tkamb live`: contact of one pose, and inserts of another thickness."""

import argparse
import logging
import shutil
import tempfile
import weakref
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock, Thread
from typing import Any

import numpy as np

from tkamb.contact.registry import contact_names
from tkamb.contact.result import ContactResult
from tkamb.errors import InputError, TkambError
from tkamb.geometry.frames import KNEE_COORDINATES, SIDES, Array, Index, knee_pose
from tkamb.io.recordings.patient import load_urdf
from tkamb.io.scene.case import Case, with_insert
from tkamb.knee.chain import Chain
from tkamb.knee.frame import Frame, FrameStart
from tkamb.run.guard import unforeseen_words
from tkamb.run.known_errors import NOT_MEASURED, ContactSituation, as_json, stated_error
from tkamb.run.read_scene import SharedState, recording_of
from tkamb.run.recording import Recording
from tkamb.show.view.bench import KEPT_MODELS, MOST_THREADS, ROWS, Bench, BenchRequest
from tkamb.show.view.bench_patella import BenchPatella, ShownPatella, patella_of
from tkamb.show.view.bench_scene import write_bench
from tkamb.studies.designs.design import DESIGN_FILE, load_design
from tkamb.studies.designs.insert import Insert
from tkamb.studies.designs.solids import write_stl
from tkamb.units import DEGREE, MEGAPASCAL, MILLIMETRE

logger = logging.getLogger("tkamb")


def parametric_insert(case: Case, folder: Path) -> Insert | None:
    """Return the parametric design of a case's insert; None: its mesh does not come from a design.

    The design is the file `DESIGN_FILE` beside the mesh. It must reproduce this mesh exactly.

    Args:
        folder: folder for the mesh that is made for the comparison.
    """
    table = case.scene.implant.insert
    assert table is not None
    if not (table.mesh.parent / DESIGN_FILE).is_file():
        return None
    try:
        insert = load_design(table.mesh.parent).insert
        copy = write_insert(insert, insert.thickness, folder)
        if copy.read_bytes() == table.mesh.read_bytes():
            return insert
        logger.warning(
            "%s: not the mesh of %s beside it: no thickness slider", table.mesh, DESIGN_FILE
        )
    except (InputError, OSError) as error:
        logger.warning("%s: %s: no thickness slider", table.mesh.parent / DESIGN_FILE, error)
    return None


def write_insert(insert: Insert, thickness_mm: float, folder: Path) -> Path:
    """Write the insert at a thickness as STL, and return the file.

    The thickness moves the dishes along y. The bottom and the insert frame do not move.
    """
    path = folder / f"insert_{thickness_mm:g}_mm.stl"
    write_stl(path, *replace(insert, thickness=thickness_mm).mesh())
    return path


def with_thickness(case: Case, insert: Insert, thickness_mm: float, folder: Path) -> Case:
    """Return a case with its parametric insert at another thickness.

    Args:
        insert: design of its insert.
        thickness_mm: smallest thickness, mm.
        folder: folder for the mesh. It must exist as long as the case is used.
    """
    return with_insert(case, write_insert(insert, thickness_mm, folder))


Setting = tuple[str, float, float | None]
"""Setting of a prepared contact model: name, spacing (mm) and thickness of the insert (mm)."""


def setting(request: BenchRequest) -> Setting:
    """Return the setting of the contact model that a request needs."""
    return request.contact, request.resolution_mm, request.thickness_mm


@dataclass(frozen=True, eq=False)
class LiveAnswer:
    """Answer to one request of the bench.

    Args:
        numbers: name with unit -> value; NaN: the value is not defined.
        status: "ok", flags in plain words, or "failed: " and the reason.
        pose: (4, 4) pose_femoral_in_insert; NaN if the state failed.
        points: (n, 3) m, points of the pressure map, insert frame.
        triangles: (k, 3) indices into the points.
        pressure: (n,) Pa, pressure at the points.
        gap: (n,) m, distance between the surfaces at the points.
        ligaments: name -> (n, 3) m, points along the ligament, insert frame.
        centres: side -> (3,) m, centre of pressure, insert frame.
        error: known error of the contact model for this contact, or "not measured: ...".
        patella: the patella; None: the request has no tension of the quadriceps.
    """

    request: BenchRequest
    numbers: dict[str, float]
    status: str
    pose: Array
    points: Array
    triangles: Index
    pressure: Array
    gap: Array
    ligaments: dict[str, Array]
    centres: dict[str, Array]
    error: dict[str, Any] | str = NOT_MEASURED
    patella: ShownPatella | None = None

    @property
    def failed(self) -> bool:
        """Whether the computation failed, so that there are no numbers."""
        return self.status.startswith("failed: ")


class LiveKnee:
    """A knee on the bench; each contact model is prepared once.

    Only the latest request counts: `answer` raises an error for an older request.

    Args:
        session: folder for the files of this session; None: a new folder. It is removed with this
            object. A saved scene has copies of the meshes in it.
        patella: released patella of a `tkamb.Knee`; None: that of the case, if it has one.

    Attributes:
        design: design of the insert; None if its mesh does not come from a parametric design.
    """

    def __init__(
        self, case: Case, session: Path | None = None, patella: BenchPatella | None = None
    ) -> None:
        if case.scene.contact is None:
            raise InputError("has no [contact]", "scene", "tkamb live shows contact: add the table")
        if case.scene.patient.scale != 1.0:
            raise InputError("is scaled", "[patient] scale", "tkamb live needs scale = 1")
        self.patella = patella or patella_of(case)
        self.case = _without_muscles(case)
        self.bench = Bench(self.case, recording_of(self.case, near=True).ligaments)
        self._session = session or Path(tempfile.mkdtemp(prefix="tkamb-live-"))
        weakref.finalize(self, shutil.rmtree, self._session, True)
        self.design = parametric_insert(case, self._session)
        self._cases: dict[float | None, Case] = {}
        self._shared: dict[float | None, SharedState] = {}
        self._recordings: dict[Setting, Recording] = {}
        self._threads: dict[Setting, Thread] = {}
        self._refused: dict[Setting, TkambError] = {}
        self._before: dict[Setting, FrameStart] = {}
        self._computing, self._counting, self._latest = Lock(), Lock(), 0

    def models(self) -> tuple[str, ...]:
        """Return the names of the contact models."""
        return contact_names()

    def recorded(self, frame: int) -> BenchRequest:
        """Return the bench at a recorded frame.

        The load is one body weight, and so is the tension on a released patella.

        Raises:
            InputError: the motion has no such frame.
        """
        motion, table = self.case.motion, self.case.scene.contact
        if not 0 <= frame < len(motion.time):
            raise InputError(
                f"there is no frame {frame}", "frame", f"give one of 0 to {len(motion.time) - 1}"
            )
        assert table is not None
        values = dict(zip(KNEE_COORDINATES, motion.coordinates[frame].tolist(), strict=True))
        return BenchRequest(
            flexion_deg=values["flexion"] / DEGREE,
            adduction_deg=values["adduction"] / DEGREE,
            axial_rotation_deg=values["axial_rotation"] / DEGREE,
            ap_mm=values["ap"] / MILLIMETRE,
            ml_mm=values["ml"] / MILLIMETRE,
            load_N=self.case.body_weight,
            contact=table.model,
            resolution_mm=table.resolution_mm,
            thickness_mm=None if self.design is None else self.design.thickness,
            quadriceps_N=None if self.patella is None else self.case.body_weight,
        )

    def overtake(self) -> int:
        """Cancel all earlier requests; return the number of the next request."""
        with self._counting:
            self._latest += 1
            return self._latest

    def preparing(self, request: BenchRequest) -> str:
        """Return the name of the contact model that is still being prepared; empty if it is ready.

        A new thread prepares the model, because a lattice takes seconds. Requests for other models
        are computed meanwhile. If `most_threads` threads run already, no thread is started. The
        page repeats its request until the model is ready.
        """
        key = setting(request)
        with self._counting:
            if key in self._recordings:
                return ""
            if key in self._refused:
                raise self._refused.pop(key)
            if key not in self._threads:
                if len(self._threads) >= MOST_THREADS:
                    names = " and ".join(f"{name} at {mm:g} mm" for name, mm, _ in self._threads)
                    return f"preparing {names}, then {request.contact}"
                thread = Thread(target=self._prepare, args=(request, key), daemon=True)
                self._threads[key] = thread
                thread.start()
        return f"preparing {request.contact} at {request.resolution_mm:g} mm"

    def _prepare(self, request: BenchRequest, key: Setting) -> None:
        problem: TkambError | None = None
        try:
            self._recording(request)
        except TkambError as error:
            problem = error
        except Exception as error:  # the last handler of this thread: the page shows the error
            problem = TkambError(unforeseen_words(error, argparse.Namespace()))
        with self._counting:
            del self._threads[key]
            if problem is not None:
                self._refused[key] = problem

    def answer(
        self, request: BenchRequest, number: int | None = None, from_rest: bool = False
    ) -> LiveAnswer:
        """Return the answer to a request.

        The previous state is the initial guess. The initial guess changes the result only within
        the tolerance of the solver.

        Args:
            number: number from `overtake`; None: newer requests do not cancel this one.
            from_rest: whether to start without an initial guess, like the first frame of a run.

        Raises:
            TkambError: a newer request has arrived.
            InputError: the contact model or spacing does not exist, or a tension of the quadriceps
                is given to a knee without a released patella.
        """
        if request.quadriceps_N is not None and self.patella is None:
            raise InputError("the knee has no released patella", "quadriceps_N", "leave it out")
        with self._computing:
            if number is not None and number != self._latest:
                raise TkambError("overtaken")
            if from_rest:
                self._before.pop(setting(request), None)
            answer = self._compute(request)
            if self.patella is None or request.quadriceps_N is None or answer.failed:
                return answer
            if from_rest:
                self.patella.forget()
            patella = self.patella.at(request, answer.pose)
            words = [*([] if answer.status == "ok" else [answer.status]), *patella.words]
            return replace(
                answer,
                numbers=answer.numbers | patella.numbers,
                status="; ".join(words) or "ok",
                patella=patella,
            )

    def save(self, request: BenchRequest, folder: Path) -> Path:
        """Write a scene for which `tkamb run` gives the same numbers; return its file.

        Args:
            folder: new or empty folder.
        """
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError("exists already and is not empty", folder, "give a new folder")
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".tkamb-live-") as beside:
                whole = Path(beside) / folder.name
                whole.mkdir()
                write_bench(self._still_case(request), whole, self._session)
                whole.replace(folder)
        except OSError as error:
            raise InputError(f"cannot be written ({error.strerror})", folder) from None
        return folder / "scene.toml"

    def _still_case(self, request: BenchRequest) -> Case:
        contact = self._recording(request).knee.contact
        assert contact is not None  # a case on the bench has contact
        height = contact.state.pair.first_touch_height
        return self.bench.case_of(request, height, self._case_with(request.thickness_mm))

    def _case_with(self, thickness_mm: float | None) -> Case:
        """Return the case with an insert of another thickness."""
        if thickness_mm is None or (self.design and thickness_mm == self.design.thickness):
            return self.case
        if self.design is None:
            what = "the insert has no parametric design"
            raise InputError(what, "thickness_mm", "leave it out")
        if thickness_mm not in self._cases:
            self._cases[thickness_mm] = with_thickness(
                self.case, self.design, thickness_mm, self._session
            )
        return self._cases[thickness_mm]

    def _recording(self, request: BenchRequest) -> Recording:
        key, insert = setting(request), request.thickness_mm
        with self._counting:
            recording = self._recordings.get(key)
        if recording is None:
            case = self.bench.case_of(request, like=self._case_with(insert))
            recording = recording_of(case, self._shared.get(insert), near=True)
            recording.method.prepare()
        with self._counting:
            if insert not in self._shared:
                contact = recording.knee.contact
                assert contact is not None  # a case on the bench has contact
                self._shared[insert] = SharedState(contact.pair, None, None, range(ROWS))
            self._recordings.pop(key, None)
            self._recordings[key] = recording  # the order of use: the latest is last
            self._forget()
        return recording

    def _forget(self) -> None:
        for old in [*self._recordings][:-KEPT_MODELS]:
            del self._recordings[old]
            self._before.pop(old, None)
        for old in [*self._refused][:-KEPT_MODELS]:
            del self._refused[old]
        needed = {thickness for _, _, thickness in (*self._recordings, *self._threads)}
        for inserts in (self._cases, self._shared):
            for thickness in inserts.keys() - needed:
                del inserts[thickness]

    def _compute(self, request: BenchRequest) -> LiveAnswer:
        ready = self._recording(request).knee.contact
        assert ready is not None
        state = ready.state
        zeros = np.zeros(len(state.points))
        empty = LiveAnswer(
            request, {}, "", np.full((4, 4), np.nan), state.points, state.triangles, zeros,
            np.full(len(zeros), np.inf), {}, {},
        )  # fmt: skip
        case = self._still_case(request)
        if not np.isfinite(case.motion.coordinates).all():
            words = "failed: the femoral component does not lie over the insert"
            return replace(empty, status=words)
        key = setting(request)
        try:
            shared = self._shared[request.thickness_mm]
            recording = recording_of(
                case, shared, near=True, contact=ready, split_sensitivity=False
            )
            before = [self._before[key]] if key in self._before and not request.released else []
            frame = recording.frame(0, before)
        except TkambError as error:
            return replace(empty, status=f"failed: {error.what}")
        result = frame.contact
        if result is None:
            return replace(empty, status=f"failed: {frame.problem}")
        if not request.released:
            self._before[key] = frame.next
        poses = {link: frame.geometry.state.pose(link) for link in ("femur", "tibia")}
        if frame.equilibrium is None:
            lifted = result.pose @ np.linalg.inv(knee_pose(case.motion.coordinates[0]))
            poses["femur"] = lifted @ poses["femur"]
        paths = {one.name: one.points(poses) for one in recording.ligaments}
        lengths = {one.name: float(one.length(poses)) for one in recording.ligaments}
        return LiveAnswer(
            request,
            _numbers(frame, recording, lengths),
            "; ".join(frame.flags) or "ok",
            result.pose,
            state.points,
            state.triangles,
            result.pressure,
            result.gap,
            paths,
            {
                side: getattr(result, side).centre_of_pressure
                for side in SIDES
                if getattr(result, side) is not None
            },
            self._known_error(request, result),
        )

    def _known_error(self, request: BenchRequest, result: ContactResult) -> Any:
        """Return the known errors of the chosen contact model, or "not measured: ..."."""
        scene = self.case.scene
        assert scene.contact is not None
        if scene.material is not None:
            return as_json(None)
        same_model = request.contact == scene.contact.model
        options = scene.contact.options if same_model else {}
        material, at = scene.contact.material, ContactSituation.of(result)
        return as_json(stated_error(request.contact, request.resolution_mm, material, options, at))


def _numbers(frame: Frame, recording: Recording, lengths: dict[str, float]) -> dict[str, float]:
    """Return name -> number. Numbers that results.csv also has use its column names."""
    result = frame.contact
    assert result is not None
    numbers = {
        "force_si_N": float(frame.loads.contact_force[1]),
        "approach_mm": result.approach / MILLIMETRE,
    }
    for side in SIDES:
        condyle = getattr(result, side)
        if condyle is None:
            continue
        numbers |= {
            f"{side}_force_N": condyle.force,
            f"{side}_area_mm2": condyle.area / MILLIMETRE**2,
            f"{side}_mean_pressure_MPa": condyle.mean_pressure / MEGAPASCAL,
            f"{side}_peak_pressure_MPa": condyle.peak_pressure / MEGAPASCAL,
            f"{side}_cop_ap_mm": float(condyle.centre_of_pressure[0]) / MILLIMETRE,
            f"{side}_cop_ml_mm": float(condyle.centre_of_pressure[2]) / MILLIMETRE,
        }
    for name, tension in frame.geometry.tensions.items():
        numbers[f"ligament_{name}_N"] = tension
    for bundle in recording.ligaments:
        strain = bundle.strain(lengths[bundle.name])
        numbers[f"ligament_{bundle.name}_strain_percent"] = 100.0 * float(strain)
    if frame.equilibrium is not None:
        places = frame.equilibrium.coordinates
        for name, value in zip(KNEE_COORDINATES, places, strict=True):
            length = name in KNEE_COORDINATES[:3]
            unit = "mm" if length else "deg"
            numbers[f"{name}_{unit}"] = float(value) / (MILLIMETRE if length else DEGREE)
    return {name: float(value) for name, value in numbers.items()}


def _without_muscles(case: Case) -> Case:
    chain = Chain(load_urdf(case.scene.patient, False), False)
    update: dict[str, Any] = {"patella": None, "muscles": None, "quadriceps": None, "muscle": ()}
    if case.scene.contact is not None:
        update["contact"] = case.scene.contact.model_copy(update={"patellofemoral": None})
    return replace(
        case,
        scene=case.scene.model_copy(update=update),
        chain=chain,
        muscles=(),
        patellar_ligament=None,
        patella=None,
        patella_heads=(),
        patella_ligaments=(),
    )
