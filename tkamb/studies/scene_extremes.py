"""Extremes of a whole run: duration, noise, friction, moment arms and damaged meshes.

The shipped knee bend is run on a few frames with one extreme parameter. The expected result is
known without a second solver:

- all: the nodal forces on the insert sum to the superior-inferior force of the equilibrium.
- time: if the motion takes `scale` times as long, the forces are F_static + F_inertia / scale².
- meshes: a damaged mesh is an error, or gives the peak pressure of the intact mesh.
"""

import math
import tempfile
import time as clock
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh

from tkamb.errors import TkambError
from tkamb.geometry.frames import Array
from tkamb.run.status import FAILED
from tkamb.studies.cases import SHIPPED_SCENE, change_recording, copied_scene, stretch_time
from tkamb.studies.verdict import MAX_ERROR, Verdict

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
