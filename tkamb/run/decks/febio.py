"""FEBio 4: one contact problem as an .feb file.

The same hexahedra and rigid femoral patch as CalculiX's deck, in mm, N and MPa. The insert is
FEBio's isotropic elastic (St. Venant-Kirchhoff) solid, in finite deformation: at small strain
Hooke's law. Contact is sliding-elastic, frictionless, by augmented Lagrangian. The patch begins at
first touch, where a load would meet no stiffness: it is lowered by the approach that tkamb found,
and FEBio answers with the force.

Reference: FEBio User Manual 4.0, chapter 3, the input file format.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from xml.etree.ElementTree import Comment, Element, SubElement, indent, tostring

import numpy as np

from tkamb.contact.lattice.meshing.cells import FACES
from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.contact.materials import LinearElastic, Material
from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index
from tkamb.run.decks.problem import PressProblem
from tkamb.units import MEGAPASCAL, MILLIMETRE


@dataclass(frozen=True)
class FebioDeckSettings:
    """What a deck for FEBio states."""

    load_steps: int = 10
    """Steps in which the displacement is applied. Chosen: FEBio halves them by itself where one
    fails."""


FEBIO_DECK = FebioDeckSettings()

FIXED = ("Rx", "Rz", "Ru", "Rv", "Rw")
"""Freedoms that the femoral component does not have: it moves along y alone."""


def febio_text(problem: PressProblem, approach: float, comments: Iterable[str] = ()) -> str:
    """Return the .feb file of a press.

    Args:
        problem: the press.
        approach: m, by which the femoral component is lowered from first touch.
        comments: for whoever opens the file, a line each.

    Raises:
        InputError: a bearing that is not fixed, or a material that is not linear.
    """
    pair = problem.pair
    if pair.bearing != "fixed":
        raise InputError("holds its inserts by the whole bottom", "FEBio's deck")
    root = Element("febio_spec", version="4.0")
    for line in comments:
        root.append(Comment(f" {line.replace('--', '–')} "))
    SubElement(root, "Module", type="solid")
    _control(root)
    _materials(root, pair.material)
    _mesh(root, problem)
    _motion(root, approach / MILLIMETRE)
    _contact(root)
    _course_and_output(root)
    indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"


def contact_quads(lattice: Lattice) -> Index:
    """Return the outer cell faces (q, 4) over the contact nodes, corners in outward order."""
    faces = lattice.cells[:, FACES].reshape(-1, 4)
    inside = np.repeat(lattice.nodes[lattice.cells].mean(axis=1), len(FACES), axis=0)
    _, first, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    touches = np.asarray(np.isin(faces, np.unique(lattice.contact_triangles)).all(axis=1))
    chosen = first[(count == 1) & touches[first]]
    quads = faces[chosen]
    corners = lattice.nodes[quads]
    normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    outward = np.einsum("ij,ij->i", normal, corners.mean(axis=1) - inside[chosen])
    return np.where(outward[:, None] < 0, quads[:, ::-1], quads)


def _control(root: Element) -> None:
    control = _filled(
        root,
        "Control",
        analysis="STATIC",
        time_steps=FEBIO_DECK.load_steps,
        step_size=1 / FEBIO_DECK.load_steps,
    )
    solver = SubElement(control, "solver", type="solid")
    for name, value in (
        ("symmetric_stiffness", "non-symmetric"),
        ("max_refs", 25),
        ("etol", 0.001),
    ):
        SubElement(solver, name).text = str(value)
    stepper = SubElement(control, "time_stepper", type="default")
    for name, value in (
        ("max_retries", 10),
        ("dtmin", 0.001),
        ("dtmax", 1 / FEBIO_DECK.load_steps),
    ):
        SubElement(stepper, name).text = str(value)


def _materials(root: Element, material: Material) -> None:
    if not isinstance(material.law, LinearElastic):
        what = "has no law that FEBio's deck knows"
        hint = "run the frame with material = 'polyethylene-linear'"
        raise InputError(what, f"material '{material.name}'", hint)
    block = SubElement(root, "Material")
    insert = SubElement(block, "material", id="1", name="insert", type="isotropic elastic")
    SubElement(insert, "density").text = "1"
    SubElement(insert, "E").text = repr(material.young_modulus / MEGAPASCAL)
    SubElement(insert, "v").text = repr(material.poisson_ratio)
    femur = SubElement(block, "material", id="2", name="femur", type="rigid body")
    SubElement(femur, "density").text = "1"
    SubElement(femur, "center_of_mass").text = "0,0,0"


def _mesh(root: Element, problem: PressProblem) -> None:
    lattice, count = problem.lattice, len(problem.lattice.nodes)
    apart = problem.patch.vertices + np.array([0.0, problem.depth, 0.0])  # at first touch
    mesh = SubElement(root, "Mesh")
    nodes = SubElement(mesh, "Nodes", name="nodes")
    for number, place in enumerate(np.concatenate([lattice.nodes, apart]) / MILLIMETRE, 1):
        SubElement(nodes, "node", id=str(number)).text = _joined(place, "{:.9e}")
    solids = SubElement(mesh, "Elements", type="hex8", name="insert")
    _members(solids, "elem", 1, lattice.cells)
    rigid = SubElement(mesh, "Elements", type="tri3", name="femur")
    _members(rigid, "elem", 1 + len(lattice.cells), problem.patch.faces + count)
    bottom = SubElement(mesh, "NodeSet", name="bottom")
    bottom.text = ",".join(str(node + 1) for node in lattice.bottom_nodes)
    top = SubElement(mesh, "Surface", name="insert_top")
    _members(top, "quad4", 1, contact_quads(lattice))
    _members(
        SubElement(mesh, "Surface", name="femoral_patch"), "tri3", 1, problem.patch.faces + count
    )
    pair = SubElement(mesh, "SurfacePair", name="knee")
    SubElement(pair, "primary").text = "insert_top"
    SubElement(pair, "secondary").text = "femoral_patch"
    domains = SubElement(root, "MeshDomains")
    SubElement(domains, "SolidDomain", name="insert", mat="insert")
    shell = SubElement(domains, "ShellDomain", name="femur", mat="femur")
    SubElement(shell, "shell_thickness").text = "0.01"


def _motion(root: Element, travel: float) -> None:
    """Hold the insert's bottom, and lower the femoral component by the travel (mm)."""
    held = SubElement(SubElement(root, "Boundary"), "bc", name="held", node_set="bottom")
    held.set("type", "zero displacement")
    for freedom in ("x_dof", "y_dof", "z_dof"):
        SubElement(held, freedom).text = "1"
    rigid = SubElement(root, "Rigid")
    fixed = SubElement(rigid, "rigid_bc", name="guided", type="rigid_fixed")
    SubElement(fixed, "rb").text = "femur"
    for freedom in FIXED:
        SubElement(fixed, f"{freedom}_dof").text = "1"
    lowered = SubElement(rigid, "rigid_bc", name="lowered", type="rigid_displacement")
    SubElement(lowered, "rb").text = "femur"
    SubElement(lowered, "dof").text = "y"
    SubElement(lowered, "value", lc="1").text = repr(-travel)
    SubElement(lowered, "relative").text = "0"


def _contact(root: Element) -> None:
    contact = _filled(
        SubElement(root, "Contact"), "contact",
        laugon="AUGLAG", tolerance=0.02, penalty=1, auto_penalty=1, two_pass=0,
        symmetric_stiffness=0,
    )  # fmt: skip
    contact.attrib.update(name="contact", type="sliding-elastic", surface_pair="knee")


def _course_and_output(root: Element) -> None:
    """Grow the travel linearly; write fields, and the femoral component's place and force."""
    curve = SubElement(SubElement(root, "LoadData"), "load_controller", id="1", type="loadcurve")
    SubElement(curve, "interpolate").text = "LINEAR"
    points = SubElement(curve, "points")
    for point in ("0,0", "1,1"):
        SubElement(points, "pt").text = point
    output = SubElement(root, "Output")
    plot = SubElement(output, "plotfile", type="febio")
    for variable in ("displacement", "stress", "contact pressure", "contact gap"):
        SubElement(plot, "var", type=variable)
    log = SubElement(output, "logfile")
    SubElement(log, "rigid_body_data", data="y;Fy", file="femur.csv")


def _filled(parent: Element, tag: str, **values: object) -> Element:
    """Return a new child with one leaf per value."""
    element = SubElement(parent, tag)
    for name, value in values.items():
        SubElement(element, name).text = str(value)
    return element


def _members(parent: Element, tag: str, first: int, members: Index) -> None:
    for number, row in enumerate(members, first):
        SubElement(parent, tag, id=str(number)).text = _joined(row + 1, "{}")


def _joined(values: Array, form: str) -> str:
    return ",".join(form.format(value) for value in values)
