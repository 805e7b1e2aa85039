"""Input files (decks) of CalculiX and FEBio 4 for a contact problem, in mm, N and MPa.

Both decks contain the hexahedra of the insert and a rigid patch of the femoral component that moves
along y only.

CalculiX: contact is node to surface by penalty. The force on a node is its pressure times its
tributary area of the deformed faces. The patch is a layer of wedges. It
starts at a guessed depth in the insert, under the whole load. CalculiX finds the equilibrium.

FEBio: the insert is an isotropic elastic (St. Venant-Kirchhoff) solid in finite deformation.
Contact is sliding-elastic and frictionless, by augmented Lagrangian. The patch is displaced from
first touch by the approach of the run, and FEBio returns the force. A load is not prescribed, since
the stiffness is zero at first touch.

Reference: FEBio User Manual 4.0, chapter 3, the input file format.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Comment, Element, SubElement, indent, tostring

import numpy as np

from tkamb.contact.lattice.meshing.cells import FACES
from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.contact.materials import LinearElastic, Material, RambergOsgood
from tkamb.contact.pair import Bearing
from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.surface import Surface
from tkamb.units import MEGAPASCAL, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.run.frame_press import PressProblem


# N/mm³: contact stiffness. The penetration is then 0.3 µm at 30 MPa.
PENALTY = 1e5


PATCH_THICKNESS = np.array([0.0, 1e-3, 0.0])
"""m: thickness of the layer of wedges that models the rigid femoral component."""


ELEMENT = "C3D8I"
"""Hexahedra with full integration and incompatible modes, which do not lock in bending."""


@dataclass(frozen=True, eq=False)
class Deck:
    """A contact problem for CalculiX.

    Args:
        lattice: nodes and hexahedra of the insert.
        patch: part of the femoral component that can touch, at its initial pose, insert frame.
        material: material of the insert.
        bearing: boundary condition of the insert's bottom.
        load: load along -y, N.
        element: "C3D8" (full integration, locks as nu approaches 0.5) or "C3D8I" (incompatible
            modes).
    """

    lattice: Lattice
    patch: Surface
    material: Material
    bearing: Bearing
    load: float
    element: str = ELEMENT
    comments: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The deck in mm, N and MPa.

        Raises:
            InputError: the deck does not support the material's law or the bearing.
        """
        comments = [f"** {line}" for line in self.comments]
        return "\n".join(
            [*comments, *self._mesh(), *self._sets(), *self._solids(), *self._step(), ""]
        )

    @property
    def _centre(self) -> int:
        return len(self.lattice.nodes) + 2 * len(self.patch.vertices) + 1

    def _mesh(self) -> list[str]:
        lattice, patch, n = self.lattice, self.patch, len(self.lattice.nodes)
        places = np.concatenate([lattice.nodes, patch.vertices, patch.vertices + PATCH_THICKNESS])
        wedges = patch.faces[:, [0, 2, 1]] + n
        wedges = np.concatenate([wedges, wedges + len(patch.vertices)], axis=1)
        lines = ["*NODE, NSET=NALL"]
        for number, (x, y, z) in enumerate(places / MILLIMETRE, 1):
            lines.append(f"{number},{x:.9e},{y:.9e},{z:.9e}")
        lines += [f"{self._centre},0.,30.,0.", f"{self._centre + 1},0.,30.,0."]
        lines += [f"*ELEMENT, TYPE={self.element}, ELSET=INSERT", *_numbered(1, lattice.cells)]
        lines.append("*ELEMENT, TYPE=C3D6, ELSET=FEMUR")
        return lines + _numbered(len(lattice.cells) + 1, wedges)

    def _sets(self) -> list[str]:
        n, m = len(self.lattice.nodes), len(self.patch.vertices)
        first = len(self.lattice.cells) + 1
        lines = _set("NBOTTOM", self.lattice.bottom_nodes)
        lines += _set("NREF", np.array([self._centre - 1])) + _set("NINSERT", np.arange(n))
        lines += _set("NSLAVE", np.unique(self.lattice.contact_triangles))
        lines += _set("NFEMUR", np.arange(n, n + 2 * m))
        lines += ["*SURFACE, NAME=SLAVE, TYPE=NODE", "NSLAVE", "*SURFACE, NAME=MASTER"]
        return lines + [f"{first + e},S1" for e in range(len(self.patch.faces))]

    def _solids(self) -> list[str]:
        return [
            *("*MATERIAL, NAME=INSERT", *_law(self.material)),
            *("*MATERIAL, NAME=STEEL", "*ELASTIC", "2.1E5,0.3"),
            "*SOLID SECTION, ELSET=INSERT, MATERIAL=INSERT",
            "*SOLID SECTION, ELSET=FEMUR, MATERIAL=STEEL",
            f"*RIGID BODY, NSET=NFEMUR, REF NODE={self._centre}, ROT NODE={self._centre + 1}",
            *("*SURFACE INTERACTION, NAME=SI", "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR"),
            f"{PENALTY},0.001",
            "*CONTACT PAIR, INTERACTION=SI, TYPE=NODE TO SURFACE",
            "SLAVE,MASTER",
        ]

    def _step(self) -> list[str]:
        if self.bearing != "fixed":
            raise InputError("can only fix the whole bottom of the insert", "CalculiX's deck")
        centre, finite = self._centre, "" if self.material.is_linear else ", NLGEOM"
        return [
            *("*BOUNDARY", "NBOTTOM,1,3", f"{centre},1,1", f"{centre},3,3", f"{centre + 1},1,3"),
            *("*STEP, INC=300" + finite, "*STATIC", "1.,1.,1e-7,1."),
            *("*CLOAD", f"{centre},2,{-self.load}"),
            *("*NODE PRINT, NSET=NREF, FREQUENCY=1000", "U"),
            *("*NODE PRINT, NSET=NINSERT, FREQUENCY=1000", "U"),
            *("*CONTACT PRINT, FREQUENCY=1000", "CSTR", "*END STEP"),
        ]


def _law(material: Material) -> list[str]:
    modulus, ratio, law = material.young_modulus / MEGAPASCAL, material.poisson_ratio, material.law
    if isinstance(law, RambergOsgood):
        stress = law.reference_stress / MEGAPASCAL
        return ["*DEFORMATION PLASTICITY", f"{modulus},{ratio},{stress},{law.exponent},{law.alpha}"]
    if isinstance(law, LinearElastic):
        return ["*ELASTIC", f"{modulus},{ratio}"]
    raise InputError("has a law that CalculiX does not have", f"material '{material.name}'")


def _numbered(first: int, members: Index) -> list[str]:
    return [f"{i},{','.join(str(v + 1) for v in row)}" for i, row in enumerate(members, first)]


def _set(name: str, nodes: Index) -> list[str]:
    return [f"*NSET, NSET={name}", *(str(v + 1) for v in nodes)]


# 1: steps of the displacement. FEBio divides a step that fails.
LOAD_STEPS = 10


FIXED = ("Rx", "Rz", "Ru", "Rv", "Rw")
"""Constrained degrees of freedom of the femoral component: it moves along y only."""


def febio_text(problem: "PressProblem", approach: float, comments: Iterable[str] = ()) -> str:
    """Return the .feb file of a contact problem.

    Args:
        approach: displacement of the femoral component along -y from first touch, m.

    Raises:
        InputError: a bearing that is not fixed, or a material that is not linear.
    """
    pair = problem.pair
    if pair.bearing != "fixed":
        raise InputError("can only fix the whole bottom of the insert", "FEBio's deck")
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
    """Return the boundary faces between contact nodes, (q, 4), with outward normals."""
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
        time_steps=LOAD_STEPS,
        step_size=1 / LOAD_STEPS,
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
        ("dtmax", 1 / LOAD_STEPS),
    ):
        SubElement(stepper, name).text = str(value)


def _materials(root: Element, material: Material) -> None:
    if not isinstance(material.law, LinearElastic):
        what = "has a law that FEBio's deck does not have"
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


def _mesh(root: Element, problem: "PressProblem") -> None:
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
    """Add the boundary conditions: fixed bottom, femoral component displaced by `travel`, mm."""
    bottom = SubElement(SubElement(root, "Boundary"), "bc", name="held", node_set="bottom")
    bottom.set("type", "zero displacement")
    for freedom in ("x_dof", "y_dof", "z_dof"):
        SubElement(bottom, freedom).text = "1"
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
    """Add the linear load curve of the displacement, and the output of fields and force."""
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
    element = SubElement(parent, tag)
    for name, value in values.items():
        SubElement(element, name).text = str(value)
    return element


def _members(parent: Element, tag: str, first: int, members: Index) -> None:
    for number, row in enumerate(members, first):
        SubElement(parent, tag, id=str(number)).text = _joined(row + 1, "{}")


def _joined(values: Array, form: str) -> str:
    return ",".join(form.format(value) for value in values)
