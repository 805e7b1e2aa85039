"""Stability study: extreme cases of contacts and of whole runs, each judged in its own process.

The shipped knee bend is run on a few frames with one extreme parameter. The expected result needs
no second solver:

- all: the nodal forces on the insert sum to the superior-inferior force of the equilibrium.
- time: if the motion takes `scale` times as long, the forces are F_static + F_inertia / scale².
- meshes: a damaged mesh is an error, or gives the peak pressure of the intact mesh.
"""

import json
import math
import multiprocessing
import signal
import tempfile
import time as clock
import tomllib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.forkserver import ensure_running
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh

from tkamb.errors import ComputationError, TkambError
from tkamb.geometry.frames import Array
from tkamb.run.status import FAILED
from tkamb.studies.cases import (
    SHIPPED_SCENE,
    Extreme,
    Shape,
    beside_calculix,
    change_recording,
    copied_scene,
    extremes,
    stretch_time,
)
from tkamb.studies.kept_rows import KeptRows, row_key
from tkamb.studies.measures import ONE_THREAD, environment
from tkamb.studies.references import ClosedForm, closed_forms
from tkamb.studies.verdict import KINDS, MAX_ERROR, Verdict, judge, judge_closed_form

if TYPE_CHECKING:
    from tkamb.run.results import Results


CONTACT = {"contact.model": "foundation", "contact.resolution_mm": 2.0}
FRAMES = slice(20, 101, 40)
TIME_SCALES = (1e-3, 1e-2, 0.1, 0.3, 3.0, 20.0, 1e4)


# Duration of the slow motion over that of the recorded motion. The inertia forces
# are then 1 % of those of the recorded motion.
SLOW_FACTOR = 10.0


NOISES = (1e-3, 1e-2, 0.1, 1.0)
FRICTIONS = (0.0, 0.2, 0.6, 1.0)
ARMS_MM = (-20.0, -60.0, -90.0, -98.0, -101.0, -104.0, -108.0, -120.0)
"""mm: anterior shifts of the tibial insertion of a straight patellar ligament. The moment arm is
zero at -98 to -108 mm, depending on flexion."""
DEFECTS = ("hole", "flipped", "doubled", "sliver", "nan", "empty", "tiny")

Check = Callable[["Results", Path], float]


@dataclass(frozen=True)
class SceneExtreme:
    """One extreme of a run.

    Args:
        kind: parameter "time", "noise", "friction" or "arm", or damaged mesh "femoral" or "insert".
        value: value of the parameter, or the defect of the mesh.
    """

    kind: str
    value: Any

    @property
    def label(self) -> str:
        """Name of the case."""
        return f"run: {self.kind} {self.value}"


def scene_extremes() -> Iterator[SceneExtreme]:
    """Return all cases; none if the shipped knee bend is not installed."""
    if not SHIPPED_SCENE.exists():
        return
    series = {"time": TIME_SCALES, "noise": NOISES, "friction": FRICTIONS, "arm": ARMS_MM}
    for kind, values in series.items():
        yield from (SceneExtreme(kind, value) for value in values)
    for part in ("femoral", "insert"):
        yield from (SceneExtreme(part, defect) for defect in DEFECTS)


def judge_scene(extreme: SceneExtreme) -> Verdict:
    """Run an extreme and check its result."""
    start = clock.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        scene = copied_scene(Path(folder))
        try:
            overrides = _apply(extreme, Path(folder))
            results = _run(scene, overrides)
            seconds = clock.perf_counter() - start
            error = _relative_error(extreme, results, Path(folder))
        except TkambError as refusal:
            seconds = clock.perf_counter() - start
            reason = str(refusal).replace(f"{folder}/", "")
            return Verdict(extreme.label, "run", "flagged", reason, seconds=seconds)
    flags = "; ".join(sorted({status for status in results.status if status != "ok"}))
    if any(status.startswith(FAILED) for status in results.status):
        return Verdict(extreme.label, "run", "flagged", flags, seconds=seconds)
    correct = math.isfinite(error) and error <= MAX_ERROR
    kind = "converged" if correct else "flagged" if flags else "unflagged_wrong"
    reason = flags if correct or flags else f"{100 * error:.3g} % from the expected result"
    finite_error = error if math.isfinite(error) else None
    return Verdict(extreme.label, "run", kind, reason, finite_error, seconds)


def _run(scene: Path, overrides: dict[str, Any]) -> "Results":
    from tkamb.io.scene import load_scene
    from tkamb.run.simulation import simulate

    return simulate(load_scene(scene, CONTACT | overrides), frames=FRAMES)


def _apply(extreme: SceneExtreme, folder: Path) -> dict[str, Any]:
    if extreme.kind == "time":
        stretch_time(folder, extreme.value)
    elif extreme.kind == "noise":
        _add_noise(folder, extreme.value)
    elif extreme.kind == "friction":
        return {"contact.friction": extreme.value}
    elif extreme.kind == "arm":
        content = tomllib.loads(SHIPPED_SCENE.read_text(encoding="utf-8"))
        x, y, z = content["patellar_ligament"]["distal"]["point_mm"]
        attachment = {"link": "tibia", "point_mm": [x + extreme.value, y, z]}
        return {"patellar_ligament.distal": attachment, "patellar_ligament.wrap": False}
    else:
        name = "femoral_component" if extreme.kind == "femoral" else "insert"
        _damage(folder / f"{name}.stl", extreme.value)
    return {}


def _relative_error(extreme: SceneExtreme, results: "Results", folder: Path) -> float:
    assert results.maps is not None
    required = results["force_si_N"]
    force = -results.maps.forces_N[:, 1]
    error = float(np.max(np.abs(force - required) / np.abs(required)))
    if extreme.kind == "time":
        recorded = _run(SHIPPED_SCENE, {})["force_si_N"]
        stretch_time(folder, SLOW_FACTOR / extreme.value)
        slow = _run(folder / "scene.toml", {})["force_si_N"]
        inertia = (recorded - slow) / (1.0 - 1.0 / SLOW_FACTOR**2)
        expected = recorded - inertia + inertia / extreme.value**2
        return max(error, float(np.max(np.abs(required - expected) / np.abs(expected))))
    if extreme.kind in ("femoral", "insert"):
        intact = _run(SHIPPED_SCENE, {})
        peak = [np.maximum(r["medial_peak_pressure_MPa"], 0) for r in (results, intact)]
        return max(error, float(np.max(np.abs(peak[0] - peak[1]) / peak[1])))
    return error


def _add_noise(folder: Path, noise: float) -> None:
    """Add noise to the knee's coordinates. `noise` is the standard deviation in mm and deg."""

    def with_noise(head: list[str], rows: Array) -> Array:
        rng = np.random.default_rng(160)
        starts = ("flex", "add", "ax", "ap", "ml")
        knee = [head.index(name) for name in head if name.startswith(starts)]
        rows[:, knee] += rng.normal(0.0, noise, (len(rows), len(knee)))
        return rows

    change_recording(folder / "motion.csv", with_noise)


def _damage(path: Path, defect: str) -> None:
    mesh = trimesh.load_mesh(path)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    if defect == "hole":
        faces = np.delete(faces, slice(len(faces) // 2, len(faces) // 2 + 3), axis=0)
    elif defect == "flipped":
        faces = faces[:, ::-1]
    elif defect == "doubled":
        faces = np.concatenate([faces, faces[::7]])
    elif defect == "sliver":
        faces = np.concatenate([faces, faces[:5, [0, 1, 1]]])
    elif defect == "nan":
        vertices[len(vertices) // 3] = np.nan
    elif defect == "tiny":
        vertices = vertices * 1e-3
    elif defect == "empty":
        faces = faces[:0]
    damaged = trimesh.Trimesh(vertices, faces, process=False)
    path.write_bytes(trimesh.exchange.stl.export_stl(damaged))


Case = Extreme | ClosedForm | SceneExtreme

STORED = Path(__file__).with_name("verdicts.json")
"""Accepted verdict on each case. `scripts/make/stability_verdicts` writes the file."""


# s: processor time limit of a model; a longer case is a hang. Usual cases take seconds.
LONGEST_SECONDS = 120.0
# s: processor time limit of a reference; a longer case is unverified. The study should end within
# a day.
LONGEST_REFERENCE_SECONDS = 900.0
# Number of processes of the study. A small computer has two cores.
WORKERS = 2
# Stride of the extreme cases that the quick study takes. It should take minutes.
QUICK_SHARE = 13
# mm: smallest cell size of the quick study. It should take minutes.
QUICK_GRID_MM = 3.0
# Number of cases of the quick study with a stored result of CalculiX. It should take minutes.
QUICK_WITH_PEER = 4


PRESSED = "pressed"
"""Message that a process sends when the model has a result."""
QUICK_SHAPES: tuple[Shape, ...] = ("swapped", "lip", "spike")


def stability_cases(quick: bool) -> list[Case]:
    """Return the cases of the study."""
    if not quick:
        return [*closed_forms(False), *extremes(), *scene_extremes()]
    coarse = (replace(c, resolution_mm=max(c.resolution_mm, QUICK_GRID_MM)) for c in extremes())
    sample = [*dict.fromkeys(coarse)][::QUICK_SHARE]
    shapes = [Extreme(resolution_mm=QUICK_GRID_MM, shape=shape) for shape in QUICK_SHAPES]
    with_calculix = list(beside_calculix())[:QUICK_WITH_PEER]
    return [*closed_forms(True), *dict.fromkeys((*with_calculix, *shapes, *sample))]


def stored_verdicts(path: Path = STORED) -> dict[str, str]:
    """Return case -> kind of its accepted verdict; empty if the file does not exist."""
    if not path.exists():
        return {}
    content: dict[str, str] = json.loads(path.read_text(encoding="utf-8"))
    return content


def run_stability(
    cases: Sequence[Case],
    longest: float = LONGEST_SECONDS,
    kept: KeptRows | None = None,
    workers: int = WORKERS,
) -> Iterator[Verdict]:
    """Judge all cases and yield their verdicts in the order of the cases.

    Args:
        longest: processor time limit of a case, s, whatever other processes do.
        kept: stored verdicts, which are not computed again; new ones are added.
    """
    judges, stored = _Judges(longest, kept), stored_verdicts()
    # Threads, and the processes that they start, leave Ctrl-C to this process, which stops them.
    block = (signal.SIG_BLOCK, {signal.SIGINT})
    pool = ThreadPoolExecutor(workers, initializer=signal.pthread_sigmask, initargs=block)
    try:
        for verdict in pool.map(judges.verdict, cases):
            yield replace(verdict, expected=stored.get(verdict.key))
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        judges.stop()
        pool.shutdown()


def kept_verdicts(
    cases: Sequence[Case], kept: KeptRows, longest: float = LONGEST_SECONDS
) -> list[Verdict]:
    """Return all stored verdicts in the order of the cases, also those not yet yielded."""
    rows, stored = [_kept_verdict(kept, case, longest) for case in cases], stored_verdicts()
    return [replace(row, expected=stored.get(row.key)) for row in rows if row is not None]


def _kept_verdict(kept: KeptRows, case: Case, longest: float) -> Verdict | None:
    return kept.read(_row_key(case, longest), Verdict)


def _row_key(case: Case, longest: float) -> str:
    return row_key(type(case).__name__, asdict(case), longest)


class _Judges:
    """Judges each case in a new process, because a case may crash or hang.

    The processes, of one thread each, are forked from a server that has imported the modules, so
    that a new one costs milliseconds.
    """

    def __init__(self, longest: float, rows: KeptRows | None) -> None:
        self._longest, self._kept = longest, rows
        self._running: set[BaseProcess] = set()
        self._stopped = False
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload([__name__])
        with environment(ONE_THREAD):
            ensure_running()

    def verdict(self, case: Case) -> Verdict:
        if self._kept is None:
            return self._judge_in_process(case)
        result = _kept_verdict(self._kept, case, self._longest)
        if result is None:
            result = self._judge_in_process(case)
            self._kept.put(_row_key(case, self._longest), asdict(result))
        return result

    def limit(self, case: Case) -> float:
        return self._longest

    def stop(self) -> None:
        self._stopped = True
        for process in list(self._running):
            process.kill()

    def _judge_in_process(self, case: Case) -> Verdict:
        receiver, sender = self._context.Pipe(duplex=False)
        limits = self.limit(case), LONGEST_REFERENCE_SECONDS
        process = self._context.Process(
            target=_send_verdict, args=(case, sender, *limits), daemon=True
        )
        process.start()
        sender.close()  # otherwise the receiver does not notice that the process has ended
        self._running.add(process)
        result: Any = None
        try:
            if self._stopped:
                raise EOFError
            result = receiver.recv()
            if result == PRESSED:
                result = receiver.recv()
            verdict: Verdict = result
            return verdict
        except EOFError:
            process.join()
            if self._stopped:
                raise ComputationError("was stopped", case.label) from None
            if process.exitcode != -signal.SIGPROF:
                reason = f"the process ended with status {process.exitcode}"
                return _ended(case, "exception", reason)
            if result == PRESSED:
                return _ended(case, "unverified", f"no reference in {limits[1]:g} s")
            return _ended(case, "hang", f"no answer in {limits[0]:g} s")
        finally:
            process.kill()
            process.join()
            self._running.discard(process)


def _send_verdict(case: Case, sender: Connection, longest: float, longest_reference: float) -> None:
    def pressed() -> None:
        signal.setitimer(signal.ITIMER_PROF, longest_reference)
        sender.send(PRESSED)

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent process handles Ctrl-C
    # SIGPROF ends the process after this processor time.
    signal.setitimer(signal.ITIMER_PROF, longest)
    sender.send(judge_safely(case, pressed))


def _ended(case: Case, kind: str, reason: str) -> Verdict:
    return Verdict(case.label, getattr(case, "model", "run"), kind, reason)


def judge_safely(case: Case, pressed: Callable[[], None] = lambda: None) -> Verdict:
    """Return the verdict; "exception" for an unexpected one."""
    try:
        if isinstance(case, Extreme):
            return judge(case, pressed)
        if isinstance(case, ClosedForm):
            return judge_closed_form(case, pressed)
        return judge_scene(case)
    except TkambError as error:
        return _ended(case, "flagged", str(error))
    except Exception as error:
        return _ended(case, "exception", f"{type(error).__name__}: {error}")


def summary(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """Return the content of `tkamb stability --json`."""
    counts = {kind: sum(v.kind == kind for v in verdicts) for kind in KINDS}
    return {
        "cases": len(verdicts),
        "converged": counts["converged"],
        "flagged": counts["flagged"],
        "unflagged_wrong": counts["unflagged_wrong"],
        "unverified": counts["unverified"],
        "exceptions": counts["exception"],
        "hangs": counts["hang"],
        "worse": sum(verdict.worse for verdict in verdicts),
        "failed": sum(verdict.failed for verdict in verdicts),
        "rows": [asdict(verdict) for verdict in verdicts],
    }


def table(verdicts: Sequence[Verdict]) -> list[str]:
    """Return the lines of the printed table: counts by contact model, then lists of cases."""
    lines = [f"{'contact':18s} {'cases':>5s} " + " ".join(f"{kind:>15s}" for kind in KINDS)]
    for model in [*dict.fromkeys(v.contact for v in verdicts), "all"]:
        group = [v for v in verdicts if model in (v.contact, "all")]
        counts = [sum(v.kind == kind for v in group) for kind in KINDS]
        lines.append(f"{model:18s} {len(group):5d} " + " ".join(f"{n:15d}" for n in counts))
    flagged = [v for v in verdicts if v.kind == "flagged" and not v.failed]
    better = [v for v in verdicts if v.kind == "converged" and v.expected not in (None, v.kind)]
    unknown = [v for v in verdicts if v.expected is None]
    groups = {"failed": [v for v in verdicts if v.failed], "flagged": flagged}
    groups |= {"better than stored": better, "no stored verdict": unknown}
    for title, group in groups.items():
        lines += ["", f"{title}: {len(group)}", *(_line(v) for v in group)]
    return lines


def _line(verdict: Verdict) -> str:
    was = f" (was {verdict.expected})" if verdict.expected not in (None, verdict.kind) else ""
    return f"  {verdict.contact}, {verdict.case}: {verdict.kind}{was}: {verdict.reason}"
