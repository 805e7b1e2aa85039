"""The lattice as the dissertation has it, behind the contract."""

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from tkamb.contact.lattice.grid import Lattice
from tkamb.contact.lattice.model import CellContact
from tkamb.contact.lattice.problem import ContactProblem, Direction
from tkamb.contact.lattice.report import PressureRule
from tkamb.contact.lattice.solid import Solid
from tkamb.contact.lattice.solver import Solution, Start, Tolerance
from tkamb.contact.lattice.source import SourceNetwork
from tkamb.contact.lattice.source_solver import solve_by_source
from tkamb.contact.materials import LinearElastic, Material
from tkamb.geometry.frames import Array


@dataclass(frozen=True)
class SourceLattice(CellContact):
    """26-neighbour springs of one stiffness k = E·C; see `tkamb.contact.lattice.source`.

    Contact is vertical as in the source: nodes are pressed along y and slide freely in x and
    z, so that no horizontal force arises. Kept for comparison: with free sides it is too
    stiff (12 % on a cube of 12 cells), and its Poisson's ratio is 0.35 whatever the material.

    Args:
        law: "nonlinear" (the material's curve on every spring) or "linear".
        loops: "stored" (one iteration on the stored response) or "source" (the source's own
            displacement-driven loops; the same answer, slower).
        pressure_rule: "source" by default.
    """

    name: ClassVar[str] = "lattice-source"
    assumes: ClassVar[str] = (
        "the source's springs k = E C (nu 0.35, too stiff at free sides), vertical contact"
    )
    needs: ClassVar[str] = "a closed insert; seconds to prepare, then tenths of a second"

    pressure_rule: PressureRule = "source"
    law: Literal["nonlinear", "linear"] = "nonlinear"
    loops: Literal["stored", "source"] = "stored"

    direction: ClassVar[Direction] = "vertical"

    def solid(self, lattice: Lattice, material: Material) -> Solid:
        """Return the network of equal springs."""
        if self.law == "linear":
            material = replace(material, law=LinearElastic())
        return SourceNetwork(
            lattice.nodes, lattice.cells, lattice.spacing, material, lattice.springs
        )

    def _solution(
        self,
        problem: ContactProblem,
        pose: Array,
        load: float | None,
        start: Start,
        tolerance: Tolerance,
    ) -> Solution:
        if self.loops == "source":
            return solve_by_source(problem, pose, load, start, tolerance)
        return super()._solution(problem, pose, load, start, tolerance)
