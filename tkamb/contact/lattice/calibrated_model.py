"""The calibrated lattice behind the contract, nonlinear and linear."""

from dataclasses import dataclass, replace
from typing import ClassVar

from tkamb.contact.lattice.grid import Lattice
from tkamb.contact.lattice.model import CellContact
from tkamb.contact.lattice.network import CalibratedNetwork
from tkamb.contact.lattice.solid import Solid
from tkamb.contact.materials import LinearElastic, Material


@dataclass(frozen=True)
class CalibratedLattice(CellContact):
    """The calibrated lattice: exact in the uniform-strain patch, any Poisson's ratio.

    28 springs per cell weighted by the share of the cells that own them plus a cell volume
    term; nonlinear by one secant shear modulus per cell (J2 deformation theory, elastic
    bulk) from the material's curve, fed with small strain. See docs/lattice.md.
    """

    name: ClassVar[str] = "lattice"
    assumes: ClassVar[str] = (
        "a spring lattice calibrated to E, nu and the stress-strain curve; small strain, "
        "no friction"
    )
    needs: ClassVar[str] = "a closed insert; seconds to prepare, then tenths of a second"

    def solid(self, lattice: Lattice, material: Material) -> Solid:
        """Return the calibrated network."""
        return CalibratedNetwork(lattice.nodes, lattice.cells, lattice.spacing, material)


@dataclass(frozen=True)
class LinearLattice(CellContact):
    """The calibrated lattice with Hooke's law: contact condensed to the surface nodes."""

    name: ClassVar[str] = "lattice-linear"
    assumes: ClassVar[str] = "a spring lattice calibrated to E and nu; linear, no friction"
    needs: ClassVar[str] = "a closed insert; seconds to prepare, then milliseconds"

    def solid(self, lattice: Lattice, material: Material) -> Solid:
        """Return the calibrated network with the material's E and nu alone."""
        linear = replace(material, law=LinearElastic())
        return CalibratedNetwork(lattice.nodes, lattice.cells, lattice.spacing, linear)
