"""A state of the bench as a scene: the files that `tkamb run` computes to the same numbers."""

import csv
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tkamb.geometry.frames import KNEE_COORDINATES, Array
from tkamb.io.recordings.recording_tables import GroundReactionTable, MotionTable, TibiaTable
from tkamb.io.recordings.scene_table import SceneTable
from tkamb.io.scene.case import Case
from tkamb.knee.load import LinkPoint
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.knee.ligaments import Ligament


def write_bench(case: Case, folder: Path, own: Path | None = None) -> Path:
    """Write a case of `Bench.case_of` as a scene that `tkamb run` reads; return the scene file.

    The URDF is copied; meshes are named where they are.

    Args:
        case: a case that stands still.
        folder: an existing folder; its files of these names are replaced.
        own: a folder of this session; its meshes are copied too.
    """
    scene, side = case.scene, -1.0 if case.scene.patient.side == "left" else 1.0
    times = case.motion.time
    write_motion(folder, times.tolist(), case.motion.coordinates, side)
    _write_table(folder / "tibia.csv", ["time_s", "lean_rad"], [[t, 0.0] for t in times])
    assert case.ground is not None
    force, point = (
        values[0] * [1.0, 1.0, side] for values in (case.ground.force, case.ground.point)
    )
    twist = side * case.ground.moment[0, 1]
    names = ["time_s", "fx_N", "fy_N", "fz_N", "px_m", "py_m", "pz_m", "my_Nm"]
    _write_table(folder / "force.csv", names, [[t, *force, *point, twist] for t in times])
    urdf = scene.patient.urdf.read_text(encoding="utf-8")
    (folder / "patient.urdf").write_text(urdf, encoding="utf-8")
    meshes = {}
    for name in ("femoral", "insert"):
        meshes[name] = getattr(scene.implant, name).model_dump(exclude_none=True)
        if own is not None and meshes[name]["mesh"].is_relative_to(own):
            copied = shutil.copy(meshes[name]["mesh"], folder)
            meshes[name]["mesh"] = Path(copied).name
    text = _scene_text(case, side, meshes)
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    return folder / "scene.toml"


def write_motion(folder: Path, times: Sequence[float], coordinates: Array, side: float) -> None:
    """Write knee coordinates (f, 6) of a right knee as [motion] of `STILL` reads them.

    Args:
        folder: for motion.csv.
        times: (f,) s.
        coordinates: m and rad.
        side: -1 of a left knee, whose ML axis points the other way; else 1.
    """
    header = ["time_s", *(f"{name}_m" for name in KNEE_COORDINATES[:3])]
    header += [f"{name}_rad" for name in KNEE_COORDINATES[3:]]
    places = coordinates.copy()
    places[:, KNEE_COORDINATES.index("ml")] *= side
    rows = [[t, *place] for t, place in zip(times, places, strict=True)]
    _write_table(folder / "motion.csv", header, rows)


def _write_table(path: Path, header: list[str], rows: list[list[float]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows([[repr(float(value)) for value in row] for row in rows])


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str | Path):
        return json.dumps(str(value), ensure_ascii=False)
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(one) for one in value)}]"
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {_toml(one)}' for key, one in value.items())} }}"
    return repr(value)


def table_lines(name: str, values: Mapping[str, Any]) -> list[str]:
    """Return the lines of one table of a scene file."""
    return [name, *(f"{key} = {_toml(value)}" for key, value in values.items()), ""]


STILL = {
    "motion": MotionTable(
        file=Path("motion.csv"),
        interpretation="coordinates",
        angle_unit="rad",
        length_unit="m",
        cutoff_Hz="none",
        columns={"time": "time_s"}
        | {name: f"{name}_m" for name in KNEE_COORDINATES[:3]}
        | {name: f"{name}_rad" for name in KNEE_COORDINATES[3:]},
    ),
    "tibia": TibiaTable(
        kind="sagittal",
        file=Path("tibia.csv"),
        columns={"time": "time_s", "angle": "lean_rad"},
        angle_unit="rad",
        ankle_mm=(0.0, 0.0, 0.0),
    ),
    "ground_reaction": GroundReactionTable(
        file=Path("force.csv"),
        length_unit="m",
        cutoff_Hz="none",
        columns={"time": "time_s"}
        | {f"force_{k}": f"f{axis}_N" for k, axis in enumerate("xyz", 1)}
        | {f"point_{k}": f"p{axis}_m" for k, axis in enumerate("xyz", 1)}
        | {"moment_2": "my_Nm"},
    ),
}
"""Tables of a scene that stands still; `write_bench` writes the files that they name."""


def _scene_text(case: Case, side: float, meshes: Mapping[str, Mapping[str, Any]]) -> str:
    scene = case.scene
    patient = scene.patient.model_dump(exclude_none=True) | {"urdf": "patient.urdf"}
    lines = ["# Written by `tkamb live`: one pose that stands still under an axial load.", ""]
    lines += table_lines("[patient]", patient)
    for name in STILL:
        table = getattr(scene, name)
        lines += table_lines(f"[{name}]", table.model_dump(include=table.model_fields_set))
    for name, mesh in meshes.items():
        lines += table_lines(f"[implant.{name}]", mesh)
    for bundle in case.ligaments:
        lines += table_lines("[[ligament]]", ligament_table(bundle, side))
    assert scene.contact is not None
    contact = _given(scene.contact)
    if scene.material is not None:
        contact.pop("material")
        lines += table_lines("[material]", _given(scene.material))
    lines += table_lines("[contact]", contact)
    notes = ["One pose that stands still under an axial load, set by hand in `tkamb live`."]
    output: dict[str, Any] = {"axis": "time", "notes": notes}
    if "yield_stress_MPa" in scene.output.model_fields_set:
        output["yield_stress_MPa"] = scene.output.yield_stress_MPa
    lines += table_lines("[output]", output)
    return "\n".join(lines)


def _given(table: SceneTable) -> dict[str, Any]:
    """Return the keys of a table that hold something."""
    values = table.model_dump(exclude_none=True)
    return {key: value for key, value in values.items() if value not in ((), {}, [])}


def ligament_table(bundle: "Ligament", side: float) -> dict[str, Any]:
    """Return a bundle as its table of a scene.

    Args:
        bundle: of a right knee, on links of the URDF, with its slack length.
        side: -1 of a left knee, else 1.
    """

    def end(point: LinkPoint) -> dict[str, Any]:
        x, y, z = (float(value) / MILLIMETRE for value in point.position)
        return {"link": point.link, "point_mm": [x, y, side * z]}

    stiffness = (
        {"stiffness_N_per_mm": float(bundle.stiffness) / 1000.0}
        if bundle.law == "two-line"
        else {"stiffness_N_per_strain": float(bundle.stiffness)}
    )
    return {
        "name": bundle.name,
        "proximal": end(bundle.proximal),
        "distal": end(bundle.distal),
        "law": bundle.law,
        **stiffness,
        "slack_length_mm": float(bundle.slack_length) / MILLIMETRE,
    }
