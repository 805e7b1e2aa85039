"""A `tkamb.Knee` on the bench of `tkamb live`: written as a scene that stands still, read again.

The page, the sliders and what is saved are then those of a scene, and a saved scene gives the same
numbers by `tkamb run`. The leg around the knee is the starter's, with the tibia's axes parallel to
the insert's: on the bench nothing depends on it. The load so acts along the insert's y axis, as in
`Knee.press`. Muscles, extensor mechanism and friction have no part in a knee that stands still.
"""

import logging
import re
import shutil
import tempfile
from dataclasses import asdict, fields, replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.contact.materials import MATERIALS, material
from tkamb.contact.registry import contact_class, contact_names
from tkamb.errors import InputError
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import Array, inverse, knee_coordinates, pose, transform
from tkamb.geometry.surface import Surface
from tkamb.io.given_material import LAW_KEYS, material_as_json
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.io.starter.person import Person, patient_urdf
from tkamb.knee.knee import Knee
from tkamb.knee.load import LinkPoint
from tkamb.knee.parts import mirrored_surface
from tkamb.show.view.bench import ROWS, BenchRequest, still_motion
from tkamb.show.view.bench_scene import STILL, ligament_table, table_lines, write_motion
from tkamb.show.view.live import LiveKnee
from tkamb.show.view.live_window import LiveWindow
from tkamb.show.view.server import ViewServer
from tkamb.show.view.show import serve_in_background
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.knee.ligaments import Ligament

logger = logging.getLogger("tkamb")


def live_knee(knee: Knee, q: Any, load: float, folder: str | Path | None) -> ViewServer:
    """Serve the live window of a knee beside the caller; see `tkamb.Knee.live`."""
    window = LiveWindow(bench_of_knee(knee, q), Path(folder or Path("out") / "live"))
    window.start = BenchRequest.read(asdict(window.start) | {"load_N": load})
    server = window.server()
    serve_in_background(server)
    return server


def bench_of_knee(knee: Knee, q: Any) -> LiveKnee:
    """Return a knee on the bench.

    Args:
        knee: with a contact model that has a name.
        q: (nq,) or (f, nq): the poses of the slider "recorded frame".

    Raises:
        InputError: no contact model, or one without a name; a q of another size; a part that a
            scene does not accept.
    """
    if knee.contact is None or knee.femoral is None or knee.insert is None:
        raise InputError("has no contact model", "Knee", "give contact= and implant=")
    placement = insert_placement(knee.insert)
    data = knee.create_data_for_kinematics()
    poses = np.array([knee.at(one, data).pose for one in np.atleast_2d(np.asarray(q, float))])
    coordinates = knee_coordinates(placement @ poses)
    own = Path(tempfile.mkdtemp(prefix="tkamb-live-"))
    try:
        case = load_case(load_scene(_write_scene(knee, placement, coordinates, own)))
    except InputError:
        shutil.rmtree(own, ignore_errors=True)
        raise
    return LiveKnee(replace(case, motion=still_motion(coordinates)), own)


def _write_scene(knee: Knee, placement: Array, coordinates: Array, folder: Path) -> Path:
    """Write the scene of a knee, and return its file.

    Args:
        knee: the knee.
        placement: (4, 4) of its insert's axes in the insert frame.
        coordinates: (f, 6) of a right knee; the first row is written.
        folder: an empty one.
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
        _write_obj(folder / f"{name}.obj", mirrored_surface(surface) if knee.left else surface)
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
    """Return the bundles between femur and tibia, under names that a scene accepts.

    Args:
        knee: the knee.
        tibia: (4, 4) of its tibia in the tibia of the scene.
    """
    bundles: list[Ligament] = []
    for bundle in knee.ligaments:
        ends = bundle.proximal, bundle.distal
        if {end.link for end in ends} != {"femur", "tibia"}:
            logger.warning("%s: not between femur and tibia: not on the bench", bundle.name)
            continue
        placed = [
            LinkPoint(end.link, transform(tibia, end.position)) if end.link == "tibia" else end
            for end in ends
        ]
        name = re.sub(r"\W", "_", bundle.name, flags=re.ASCII)
        bundles.append(replace(bundle, name=name, proximal=placed[0], distal=placed[1]))
    return bundles


def _contact_lines(knee: Knee) -> list[str]:
    """Return [contact] and [material] of a knee.

    Raises:
        InputError: a contact model without a name, or an option or a law that no scene holds.
    """
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
    given = knee.implant.insert_material
    built_in = next((one for one in MATERIALS if material(one) == given), None)
    if built_in is not None:
        return table_lines("[contact]", contact | {"material": built_in})
    values = material_as_json(given)
    if values["law"] not in LAW_KEYS:
        raise InputError(f"material law {values['law']}", "Knee.live", "a scene cannot hold it")
    if values["name"] in MATERIALS:
        values["name"] += " (changed)"
    return table_lines("[material]", values) + table_lines("[contact]", contact)


def _write_obj(path: Path, surface: Surface) -> None:
    """Write a surface as OBJ, every digit of its coordinates kept."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in surface.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (surface.faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
