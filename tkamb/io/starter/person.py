"""The files of `tkamb new` for a patient of given mass, height, sex and side.

Lengths are shares of body height (Drillis and Contini 1966, as in Winter 2009, figure 4.1): ankle
0.039, shank 0.246, thigh 0.245. Masses and inertias are from de Leva (1996), see
`tkamb.io.recordings.patient`. Joint centres, attachments on the femoral shaft, the ground reaction
and its point are scaled. The implant and attachments near the knee are not scaled, but move with
the knee. A left leg is the mirror image: positions along z, the force to the right, and the meshes
change sign.

References: Winter (2009), Biomechanics and Motor Control of Human Movement, 4th ed., Wiley,
doi:10.1002/9780470549148; de Leva (1996), J Biomech 29:1223, doi:10.1016/0021-9290(95)00178-6.
"""

import csv
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import MIRROR, Array
from tkamb.io.recordings.patient import RigidInertia, Sex, combined, segment_inertia

MESHES = ("femoral_component", "insert", "patellar_button")


# Height of the ankle's centre above ground, as a share of body height; Winter (2009).
ANKLE = 0.039
# Distance from ankle centre to knee centre, as a share of body height; Winter (2009).
SHANK = 0.246
# Distance from knee centre to hip centre, as a share of body height; Winter (2009).
THIGH = 0.245
# m: depth of the insert's bottom below the knee's centre, as in the shipped patient.
INSERT_BELOW_KNEE = 0.018662
# m: height of the femoral component's origin above the knee's centre, as in the shipped patient.
HIP_BELOW_THIGH_END = 0.004367
# kg: smallest accepted mass. It excludes masses in other units.
LIGHTEST = 20.0
# kg: greatest accepted mass. It excludes masses in other units.
HEAVIEST = 300.0
# m: smallest accepted height. It excludes heights in other units.
SHORTEST = 1.0
# m: greatest accepted height. It excludes heights in other units.
TALLEST = 2.3


@dataclass(frozen=True)
class Person:
    """A patient for the files of `tkamb new`.

    Args:
        mass: body mass, kg.
        height: body height, m.
        sex: "female" or "male", which selects the table of de Leva (1996).
    """

    side: Literal["left", "right"] = "right"
    mass: float = 75.0
    height: float = 1.75
    sex: Sex = "male"

    def __post_init__(self) -> None:
        if not LIGHTEST <= self.mass <= HEAVIEST:
            hint = f"give {LIGHTEST:g} to {HEAVIEST:g} kg"
            raise InputError(f"a body of {self.mass:g} kg", "--mass-kg", hint)
        if not SHORTEST <= self.height <= TALLEST:
            hint = f"give {SHORTEST * 1e3:g} to {TALLEST * 1e3:g}, in mm"
            raise InputError(f"a height of {self.height * 1e3:g} mm", "--height-mm", hint)

    @property
    def knee_height(self) -> float:
        """Height of the insert's bottom above the ankle's centre, m."""
        return SHANK * self.height - INSERT_BELOW_KNEE

    @property
    def hip_height(self) -> float:
        """Height of the hip's centre above the femoral component's origin, m."""
        return THIGH * self.height - HIP_BELOW_THIGH_END

    def inertias(self) -> dict[str, RigidInertia]:
        """Return link -> its inertia in its frame: "tibia" (shank and foot) and "femur"."""
        ankle, knee = np.zeros(3), np.array([0.0, self.knee_height, 0.0])
        hip = np.array([0.0, self.hip_height, 0.0])
        shank = segment_inertia("shank", self.sex, self.mass, knee, ankle)
        foot = segment_inertia("foot", self.sex, self.mass, ankle, np.array([0.0, -1.0, 0.0]))
        thigh = segment_inertia("thigh", self.sex, self.mass, hip, np.zeros(3))
        return {"tibia": combined(shank, foot), "femur": thigh}


def write_person(folder: Path, person: Person) -> None:
    """Adapt the starter's files in a folder to a person."""
    urdf, scene = folder / "patient.urdf", folder / "scene.toml"
    urdf.write_text(patient_urdf(urdf.read_text(encoding="utf-8"), person), encoding="utf-8")
    scene.write_text(scene_text(scene.read_text(encoding="utf-8"), person), encoding="utf-8")
    weight, size = person.mass / Person().mass, person.height / Person().height
    mirror = -1.0 if person.side == "left" else 1.0
    _scale(
        folder / "ground_reaction.csv",
        {
            "force_x_N": weight,
            "force_y_N": weight,
            "force_z_N": mirror * weight,
            "point_x_mm": size,
            "point_z_mm": mirror * size,
        },
    )
    if person.side == "left":
        _scale(folder / "motion.csv", {"ml_mm": -1.0})
        for name in MESHES:
            _mirror_mesh(folder / f"{name}.stl")


def patient_urdf(text: str, person: Person) -> str:
    """Return the starter's URDF with a person's lengths, inertias and side."""
    robot = ElementTree.fromstring(text)
    robot.set("name", "patient")
    heights = {
        "ankle": ANKLE * person.height,
        "knee_ap": person.knee_height,
        "hip_centre": person.hip_height,
    }
    for joint in robot.findall("joint"):
        name, axis = joint.get("name", ""), joint.find("axis")
        if name in heights:
            _child(joint, "origin").set("xyz", f"0 {heights[name]:.6f} 0")
        # In a mirrored leg, rotations about the anterior and superior axes have the opposite sign.
        if person.side == "left" and axis is not None and joint.get("type") == "revolute":
            x, y, z = (float(value) for value in axis.get("xyz", "").split())
            axis.set("xyz", f"{-x:g} {-y:g} {z:g}".replace("-0 ", "0 "))
    for link in robot.findall("link"):
        inertia = person.inertias().get(link.get("name", ""))
        if inertia is not None:
            _write_inertia(_child(link, "inertial"), inertia)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def scene_text(text: str, person: Person) -> str:
    """Return the starter's scene with a person's mass, height, sex, side and attachments."""
    default_person = Person()
    for key, value in {
        "side": f'"{person.side}"',
        "mass_kg": f"{person.mass:g}",
        "sex": f'"{person.sex}"',
        "height_mm": f"{person.height * 1e3:g}",
    }.items():
        text = re.sub(rf"(?m)^{key} = [^\s#]+", f"{key} = {value}", text)
    ankle = ANKLE * person.height * 1e3
    text = re.sub(r"(?m)^ankle_mm = \[.*?\]", f"ankle_mm = [0.0, {ankle:.2f}, 0.0]", text)
    knee_up = (person.knee_height - default_person.knee_height) * 1e3
    thigh = person.hip_height / default_person.hip_height
    mirror = -1.0 if person.side == "left" else 1.0

    def point(match: re.Match[str]) -> str:
        x, y, z = (float(value) for value in match["point"].split(","))
        if match["link"] == "tibia":
            y += knee_up  # all attachments on the tibia are near the knee
        elif match["link"] == "femur" and y > INSERT_BELOW_KNEE * 1e3:
            y *= thigh  # on the shaft; points near the knee keep their distance from the implant
        z = mirror * z + 0.0
        return f'link = "{match["link"]}", point_mm = [{x:g}, {round(y, 3):g}, {z:g}]'

    pattern = r'link = "(?P<link>\w+)", point_mm = \[(?P<point>[^\]]+)\]'
    return re.sub(pattern, point, text)


def _child(element: ElementTree.Element, tag: str) -> ElementTree.Element:
    child = element.find(tag)
    return ElementTree.SubElement(element, tag) if child is None else child


def _write_inertia(inertial: ElementTree.Element, inertia: RigidInertia) -> None:
    _child(inertial, "origin").set("xyz", _numbers(inertia.centre))
    _child(inertial, "mass").set("value", f"{inertia.mass:.6f}")
    tensor = _child(inertial, "inertia")
    for i, first in enumerate("xyz"):
        for j, second in enumerate("xyz"):
            if i <= j:
                tensor.set(f"i{first}{second}", f"{inertia.tensor[i, j]:.9f}")


def _numbers(values: Array) -> str:
    return " ".join(f"{value:.6f}" for value in values)


def _scale(path: Path, factors: dict[str, float]) -> None:
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    factor_of: list[Callable[[str], str]] = [
        (lambda text, by=factors[name]: f"{float(text) * by + 0.0:.6g}")  # type: ignore[misc]
        if not math.isclose(factors.get(name, 1.0), 1.0)
        else str
        for name in header
    ]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(
            [[f(text) for f, text in zip(factor_of, row, strict=True)] for row in rows]
        )


def _mirror_mesh(path: Path) -> None:
    """Mirror a mesh in the sagittal plane, still facing outwards."""
    import trimesh

    mesh = trimesh.load_mesh(path, process=False)
    trimesh.Trimesh(mesh.vertices @ MIRROR, mesh.faces[:, ::-1], process=False).export(path)
