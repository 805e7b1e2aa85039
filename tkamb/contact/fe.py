"""Finite elements on the lattice's grid, with the lattice's contact: the yardstick."""

from dataclasses import dataclass
from typing import ClassVar

from tkamb.contact.lattice.bbar import BbarHexahedra
from tkamb.contact.lattice.grid import Lattice
from tkamb.contact.lattice.model import CellContact
from tkamb.contact.lattice.solid import Solid
from tkamb.contact.materials import Material


@dataclass(frozen=True)
class FiniteElements(CellContact):
    """B-bar hexahedra (mean dilatation), J2 deformation theory at eight Gauss points.

    Grid, active set and pressure rules are those of the lattice; small strain.
    """

    name: ClassVar[str] = "fe"
    assumes: ClassVar[str] = "finite elements (B-bar hexahedra) with J2 deformation theory"
    needs: ClassVar[str] = "a closed insert; seconds to prepare, then tenths of a second"

    def solid(self, lattice: Lattice, material: Material) -> Solid:
        """Return the hexahedra."""
        return BbarHexahedra(lattice.nodes, lattice.cells, lattice.spacing, material)
