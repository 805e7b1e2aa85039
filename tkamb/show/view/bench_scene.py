"""Write a state of the bench as a scene, from which `tkamb run` computes the same numbers."""

import csv
import logging
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.contact.materials import MATERIALS, material
from tkamb.contact.registry import contact_class, contact_names
from tkamb.errors import InputError
from tkamb.geometry.frames import KNEE_COORDINATES, Array, inverse, pose
from tkamb.geometry.surface import Surface
from tkamb.io.given_material import LAW_KEYS, material_as_json
from tkamb.io.recordings.motion import KneeMotion
from tkamb.io.recordings.recording_tables import (
    GroundReactionTable,
    MotionTable,
    SceneTable,
    TibiaTable,
)
from tkamb.io.scene.case import Case
from tkamb.io.scene.parts import wrap_table
from tkamb.io.scene.tables import STIFFNESS_KEYS
from tkamb.io.starter.person import Person, patient_urdf
from tkamb.io.toml_text import table_lines
from tkamb.knee.knee import Knee
from tkamb.knee.ligament_laws import law_name
from tkamb.knee.load import LinkPoint
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.knee.ligaments import Ligament

logger = logging.getLogger("tkamb")

ROWS = 6
"""Number of equal rows in the tables. Accelerations need at least this number."""


def write_bench(case: Case, folder: Path, session: Path | None = None) -> Path:
    """Write a case of `Bench.case_of` as a scene for `tkamb run`, and return the scene file.

    The URDF is copied. The scene holds the paths of meshes outside `session`.

    Args:
        session: folder with meshes of this session, which are copied; None: no mesh is copied.
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
        if session is not None and meshes[name]["mesh"].is_relative_to(session):
            copied = shutil.copy(meshes[name]["mesh"], folder)
            meshes[name]["mesh"] = Path(copied).name
    text = _scene_text(case, side, meshes)
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    return folder / "scene.toml"


def write_motion(folder: Path, times: Sequence[float], coordinates: Array, side: float) -> None:
    """Write knee coordinates (f, 6) of a right knee to motion.csv, the [motion] file of `STILL`.

    Args:
        times: times, s, shape (f,).
        coordinates: knee coordinates, m and rad, shape (f, 6).
        side: -1 for a left knee, because its ML axis is reversed; 1 for a right knee.
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
"""Tables of a static scene. `write_bench` writes their files."""


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
    """Return the keys of a table that have a value."""
    values = table.model_dump(exclude_none=True)
    return {key: value for key, value in values.items() if value not in ((), {}, [])}


def ligament_table(bundle: "Ligament", side: float) -> dict[str, Any]:
    """Return a bundle as its table of a scene.

    Args:
        bundle: ligament of a right knee with its slack length; its ends are on links of the URDF.
        side: -1 for a left knee, 1 for a right knee.
    """

    def end(point: LinkPoint) -> dict[str, Any]:
        x, y, z = (float(value) / MILLIMETRE for value in point.position)
        return {"link": point.link, "point_mm": [x, y, side * z]}

    key, unit = STIFFNESS_KEYS[bundle.law.unit]
    table = {
        "name": bundle.name,
        "proximal": end(bundle.proximal),
        "distal": end(bundle.distal),
        "law": law_name(bundle.law),
        key: float(bundle.law.stiffness) / unit,
        "slack_length_mm": float(bundle.slack_length) / MILLIMETRE,
    }
    if bundle.wraps:
        table["wrap"] = [wrap_table(wrap, side < 0) for wrap in bundle.wraps]
    return table


def still_motion(coordinates: Array) -> KneeMotion:
    """Return a motion without velocity from knee coordinates (f, 6), m and rad, of a right knee."""
    frames = len(coordinates)
    rates, deviation = np.zeros((frames, 6)), np.zeros(frames)
    time = np.arange(frames, dtype=float)
    return KneeMotion(time, coordinates, rates, rates, coordinates, deviation, deviation)


def write_knee(knee: Knee, placement: Array, coordinates: Array, folder: Path) -> Path:
    """Write a `tkamb.Knee` as a static scene, and return the scene file.

    The scene has the leg of `tkamb new`, because no result of the bench depends on the leg. The
    axes of its tibia are parallel to those of the insert frame, so the load acts along y of the
    insert, as in `Knee.press`. The scene has no muscles, extensor mechanism or friction.

    Args:
        placement: (4, 4) pose of the insert's mesh in the insert frame (`insert_placement`).
        coordinates: knee coordinates (f, 6) of a right knee. Only the first row is written.
        folder: empty folder.
    """
    sign = -1.0 if knee.left else 1.0
    assert knee.femoral is not None and knee.insert is not None
    leg = resources.files("tkamb.io.starter") / "files" / "patient.urdf"
    person = Person(knee.side)
    urdf = patient_urdf(leg.read_text(encoding="utf-8"), person)
    (folder / "patient.urdf").write_text(urdf, encoding="utf-8")
    write_motion(folder, range(ROWS), np.tile(coordinates[0], (ROWS, 1)), sign)
    motion = STILL["motion"]
    lines = ["# A tkamb.Knee on the bench of `tkamb live`.", ""]
    lines += table_lines(
        "[patient]", {"urdf": "patient.urdf", "side": knee.side, "mass_kg": person.mass}
    )
    lines += table_lines("[motion]", motion.model_dump(include=motion.model_fields_set))
    for name, surface in (("femoral", knee.femoral), ("insert", knee.insert)):
        _write_obj(folder / f"{name}.obj", surface.mirrored() if knee.left else surface)
        mesh = {"mesh": f"{name}.obj", "unit": "m"}
        if name == "insert":
            mesh["bearing"] = knee.implant.bearing
        lines += table_lines(f"[implant.{name}]", mesh)
    shank = pose(np.eye(3), np.array([0.0, person.knee_height, 0.0]))
    tibia = shank @ placement @ inverse(knee.chain.insert_in_tibia)
    for bundle in _bundles(knee, tibia):
        lines += table_lines("[[ligament]]", ligament_table(bundle, sign))
    lines += _contact_lines(knee)
    (folder / "scene.toml").write_text("\n".join(lines), encoding="utf-8")
    return folder / "scene.toml"


def _bundles(knee: Knee, tibia: Array) -> "list[Ligament]":
    """Return the bundles between femur and tibia, with names that a scene accepts.

    Args:
        tibia: (4, 4) pose of the knee's tibia link in the tibia link of the scene.
    """
    bundles: list[Ligament] = []
    for bundle in knee._instant_ligaments:
        if set(bundle.links) != {"femur", "tibia"}:
            logger.warning("%s: not between femur and tibia: not on the bench", bundle.name)
            continue
        placed = bundle.on_links({"tibia": ("tibia", tibia), "femur": ("femur", np.eye(4))})
        name = re.sub(r"\W", "_", bundle.name, flags=re.ASCII)
        bundles.append(replace(placed, name=name))
    return bundles


def _contact_lines(knee: Knee) -> list[str]:
    """Return [contact] and [material] of a knee."""
    assert knee.contact is not None
    model: Any = knee.contact.model
    name = next((one for one in contact_names() if contact_class(one) is type(model)), None)
    if name is None:
        raise InputError(
            f"its contact model {type(model).__name__} has no name",
            "Knee.live",
            "offer it by an entry point (docs/contact_model.md): the page chooses models by name",
        )
    options = {
        field.name: getattr(model, field.name)
        for field in fields(model)
        if field.init and field.name != "resolution" and getattr(model, field.name) != field.default
    }
    for option, value in options.items():
        if not isinstance(value, bool | int | float | str):
            raise InputError(
                f"option '{option}' = {value!r}", "Knee.live", "a scene cannot hold it"
            )
    contact: dict[str, Any] = {"model": name, "resolution_mm": model.resolution / MILLIMETRE}
    contact |= {"options": options} if options else {}
    insert_material = knee.implant.insert_material
    built_in = next((one for one in MATERIALS if material(one) == insert_material), None)
    if built_in is not None:
        return table_lines("[contact]", contact | {"material": built_in})
    values = material_as_json(insert_material)
    if values["law"] not in LAW_KEYS:
        raise InputError(f"material law {values['law']}", "Knee.live", "a scene cannot hold it")
    if values["name"] in MATERIALS:
        values["name"] += " (changed)"
    return table_lines("[material]", values) + table_lines("[contact]", contact)


def _write_obj(path: Path, surface: Surface) -> None:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in surface.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (surface.faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
