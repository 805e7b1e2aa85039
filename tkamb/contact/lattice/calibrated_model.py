"""The calibrated lattice behind the contract, nonlinear and linear."""

from dataclasses import dataclass, replace
from typing import ClassVar

from tkamb.contact.lattice.grid import Lattice
from tkamb.contact.lattice.model import CellContact
from tkamb.contact.lattice.network import CalibratedNetwork
from tkamb.contact.lattice.problem import ContactProblem
from tkamb.contact.lattice.solid import Solid
from tkamb.contact.lattice.solver import Start
from tkamb.contact.materials import LinearElastic, Material
from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.units import MILLIMETRE

NEAR = 0.5e-3
"""m; such nodes count as near, see `CalibratedLattice`."""


@dataclass(frozen=True)
class CalibratedLattice(CellContact):
    """The calibrated lattice: exact in the uniform-strain patch, any Poisson's ratio.

    28 springs per cell weighted by the share of the cells that own them plus a cell volume
    term; nonlinear by one secant shear modulus per cell (J2 deformation theory, elastic
    bulk) from the material's curve, fed with small strain. See docs/lattice.md.

    Args:
        nonlinear_within_mm: cells farther than this (middle to node, mm) from the contact nodes
            that can be touched, or lie within 0.5 mm of the femoral component at first touch,
            stay linear; None: all follow the curve.
    """

    name: ClassVar[str] = "lattice"
    assumes: ClassVar[str] = (
        "a spring lattice calibrated to E, nu and the stress-strain curve; small strain, "
        "no friction"
    )
    needs: ClassVar[str] = "a closed insert; seconds to prepare, then tenths of a second"

    nonlinear_within_mm: float | None = None

    def __post_init__(self) -> None:
        """Refuse a distance that is none."""
        within = self.nonlinear_within_mm
        if within is not None and not within > 0:
            raise InputError(
                f"nonlinear_within_mm = {within:g}", "contact.options", "give more than 0 mm"
            )

    def solid(self, lattice: Lattice, material: Material) -> Solid:
        """Return the calibrated network."""
        return CalibratedNetwork(lattice.nodes, lattice.cells, lattice.spacing, material)

    def _posed(self, problem: ContactProblem, gaps: Array, start: Start) -> ContactProblem:
        solid, within = problem.solid, self.nonlinear_within_mm
        if within is None or not isinstance(solid, CalibratedNetwork):
            return problem
        near = gaps - gaps.min() <= NEAR
        near[start.candidates] = True
        points = problem.surface_points[near]
        return replace(problem, solid=solid.softening_within(points, within * MILLIMETRE))


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
