"""CalculiX: one contact problem as it reads it.

Hexahedra, a rigid patch, penalty contact, a load. The femoral patch is a rigid layer of
wedges that may move along y only. It begins at a guessed depth in the insert and is let go under
the whole load: CalculiX closes the overlap and finds the balance in one increment, or in as many as
it needs. Contact is node to surface, so that a node carries its pressure times its share of the
deformed faces around it.
"""

from dataclasses import dataclass

import numpy as np

from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.contact.materials import LinearElastic, Material, RambergOsgood
from tkamb.contact.pair import Bearing
from tkamb.errors import InputError
from tkamb.geometry.frames import Index
from tkamb.geometry.surface import Surface
from tkamb.units import MEGAPASCAL, MILLIMETRE


@dataclass(frozen=True)
class CalculixDeckSettings:
    """What a deck for CalculiX states."""

    penalty: float = 1e5
    """N/mm³; contact stiffness. Chosen: at 30 MPa surfaces overlap by 0.3 µm."""


CALCULIX_DECK = CalculixDeckSettings()

PATCH_THICKNESS = np.array([0.0, 1e-3, 0.0])
"""m: of the layer of wedges that stands for the rigid femoral component."""


ELEMENT = "C3D8I"
"""Fully integrated with incompatible modes: does not lock as nu nears 0.5 in bending."""


@dataclass(frozen=True, eq=False)
class Deck:
    """What CalculiX is asked.

    Args:
        lattice: nodes and hexahedra of the insert.
        patch: the part of the femoral component that can touch, insert frame, where it begins.
        material: of the insert.
        bearing: how the bottom is held.
        load: N, along -y.
        element: "C3D8" (fully integrated, locks as nu nears 0.5), "C3D8I" (incompatible modes).
        comments: for whoever opens the deck, a line each.
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
        """The input in mm, N and MPa.

        Raises:
            InputError: the material's law or the bearing is not one of CalculiX's here.
        """
        comments = [f"** {line}" for line in self.comments]
        return "\n".join(
            [*comments, *self._mesh(), *self._sets(), *self._solids(), *self._step(), ""]
        )

    @property
    def _centre(self) -> int:
        """Number of the node that moves the rigid patch."""
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
            f"{CALCULIX_DECK.penalty},0.001",
            "*CONTACT PAIR, INTERACTION=SI, TYPE=NODE TO SURFACE",
            "SLAVE,MASTER",
        ]

    def _step(self) -> list[str]:
        if self.bearing != "fixed":
            raise InputError("holds its inserts by the whole bottom", "CalculiX's deck")
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
    raise InputError("has no law that CalculiX knows", f"material '{material.name}'")


def _numbered(first: int, members: Index) -> list[str]:
    return [f"{i},{','.join(str(v + 1) for v in row)}" for i, row in enumerate(members, first)]


def _set(name: str, nodes: Index) -> list[str]:
    return [f"*NSET, NSET={name}", *(str(v + 1) for v in nodes)]
