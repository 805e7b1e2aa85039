"""Sharma's own loops: displacement-driven, one sparse solve per contact set.

Sharma (2008), section 4.5.5. Nodes in contact are given the vertical displacement that the
femoral component asks of them and slide freely in x and z; the others must carry no force.

Linear: a unit dummy displacement of the nodes in contact gives the slope of the reaction, so
that one correction of D reaches the load while the set stays. Nonlinear: at fixed D the free
unknowns are iterated to zero force with the tangent springs, then D_new = D
(F_load/F_reaction)^(1/m). Sharma (2008) has m = 1, which oscillates for ever where the reaction
grows with the square of D or faster, as it does while nodes come in; from the second D on m is
the growth seen between the last two.
Sharma (2008) leaves open what happens to nodes that would be pulled: here they are let go, and
nodes that the femoral component would pass are caught.
"""

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
import scipy.sparse as sparse

from tkamb.contact.lattice.active_set import ContactForces
from tkamb.contact.lattice.initial_guess import InitialGuess
from tkamb.contact.lattice.linear.operator import prepare_operator
from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.contact.lattice.model import CellContact
from tkamb.contact.lattice.problem import ContactProblem, Direction, TangentPlanes
from tkamb.contact.lattice.report import PressureRule
from tkamb.contact.lattice.solids.solid import Solid
from tkamb.contact.lattice.solver import SlidingNodes, Solution, Tolerance
from tkamb.contact.lattice.source.springs import SourceNetwork
from tkamb.contact.materials import LinearElastic, Material
from tkamb.geometry.frames import Array, Index, Mask

MOST_LOOPS = 60
MOST_STEPS = 30
_NO_NODES = np.zeros(0, np.int64)
FIRST_DEPTH = 0.5
"""First D, as a share of the depth that the candidates cover."""


@dataclass(frozen=True)
class SourceLattice(CellContact):
    """26-neighbour springs of one stiffness k = E·C; see `tkamb.contact.lattice.source`.

    Contact is vertical as in Sharma (2008): nodes are pressed along y and slide freely in x and
    z, so that no horizontal force arises. Kept for comparison: with free sides it is too
    stiff (12 % on a cube of 12 cells), and its Poisson's ratio is 0.35 whatever the material.

    Args:
        law: "nonlinear" (the material's curve on every spring) or "linear".
        loops: "stored" (one iteration on the stored response) or "source" (Sharma's own
            displacement-driven loops; the same answer, slower).
        pressure_rule: "source" by default.
    """

    name: ClassVar[str] = "lattice-source"
    assumes: ClassVar[str] = (
        "Sharma's springs k = E C (nu 0.35, too stiff at free sides), vertical contact"
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
            lattice.nodes, lattice.cells, lattice.spacing, material, lattice.springs.ends
        )

    def _solution(
        self,
        problem: ContactProblem,
        pose: Array,
        load: float | None,
        guess: InitialGuess,
        tolerance: Tolerance,
        within: float,
    ) -> Solution:
        if self.loops == "source":
            return solve_by_loops(problem, pose, load, guess, tolerance)
        return super()._solution(problem, pose, load, guess, tolerance, within)


@dataclass(frozen=True, eq=False)
class _Pressed:
    """Vertical forces (m,) on all candidates and displacements (n, 3) at one D."""

    force: Array
    field: Array
    slope: float
    residual: float


def solve_by_loops(
    problem: ContactProblem,
    pose: Array,
    load: float | None,
    guess: InitialGuess,
    tolerance: Tolerance,
) -> Solution:
    """Return the contact at a pose under a load (N), or at approach 0 when load is None.

    `guess` gives candidates and how deep they reach; for the others see `solver.solve`. The
    problem's `direction` is "vertical".
    """
    nodes = problem.contact_nodes[guess.candidates]
    points = problem.surface_points[guess.candidates]
    sliding = SlidingNodes(problem, points, np.zeros_like(points), pose, guess.planes)
    depth = 0.0 if load is None else FIRST_DEPTH * float(guess.reach)
    field, loops = np.zeros_like(problem.solid.nodes), 0
    active, seen = sliding.planes.gap(points) < depth, []
    while True:
        loops += 1
        planes = sliding.planes
        pressed = _press(problem, nodes, points, planes, active, depth, field, tolerance)
        field, moved = pressed.field, pressed.field[nodes]
        reaction = float(pressed.force.sum())
        missed = 0.0 if load is None else abs(reaction - load) / load
        changed = _next_active(points + moved, planes, active, pressed.force, depth)
        opening = np.where(active, 0.0, planes.gap(points + moved) - depth)
        force = np.where(active, np.maximum(pressed.force, 0), 0.0)
        forces = ContactForces(force, opening, depth, active, loops, True)
        settled = tolerance.at_rest(sliding.follow(moved, forces), loops == MOST_LOOPS)
        still = bool((changed == active).all())
        done = still and settled and max(missed, pressed.residual) <= tolerance.force
        if done or loops == MOST_LOOPS:
            return _solution(guess, forces, planes, pressed, nodes, loops, missed, done)
        if load is not None and still:
            seen.append((depth, reaction))
            depth = _next_depth(problem, seen, load, pressed.slope)
            changed = changed | (sliding.planes.gap(points + moved) < depth) & ~active
        active = changed


def _next_depth(
    problem: ContactProblem, seen: list[tuple[float, float]], load: float, slope: float
) -> float:
    """Return D by the dummy displacement's slope (linear) or by the secant (nonlinear)."""
    depth, reaction = seen[-1]
    if problem.solid.material.is_linear:
        return depth + (load - reaction) / slope
    growth = 1.0
    if len(seen) > 1 and depth != seen[-2][0] and min(reaction, seen[-2][1]) > 0:
        growth = np.log(reaction / seen[-2][1]) / np.log(depth / seen[-2][0])
    ratio = (load / max(reaction, 1e-12)) ** (1 / max(growth, 1.0))
    return depth * float(np.clip(ratio, 0.25, 4.0))


def _next_active(
    positions: Array, planes: TangentPlanes, active: Mask, force: Array, depth: float
) -> Mask:
    """Return the set without nodes that are pulled, with nodes that would be passed."""
    return (active & (force >= 0)) | (~active & (planes.gap(positions) < depth))


def _press(
    problem: ContactProblem,
    nodes: Index,
    points: Array,
    planes: TangentPlanes,
    active: Mask,
    depth: float,
    field: Array,
    tolerance: Tolerance,
) -> _Pressed:
    """Give the active nodes their vertical displacement and bring the rest to zero force.

    The first step spreads the change with the undeformed stiffness, as in Sharma (2008); then
    tangent steps, halved while they would raise the unbalanced force.
    """
    solid, held = problem.solid, problem.held.copy()
    chosen = 3 * nodes[active] + 1
    held[chosen] = True
    asked = np.zeros(len(held))
    asked[chosen] = planes.points[active, 1] - depth - points[active, 1]
    asked[chosen] -= field.ravel()[chosen]
    u = field + _spread(solid.stiffness, problem, held, asked).reshape(-1, 3)
    force, residual, internal = _balance(problem, u, held, chosen)
    for _ in range(MOST_STEPS):
        if residual <= 1e-2 * tolerance.force:
            break
        operator = prepare_operator(solid.tangent(u), problem.index, held, _NO_NODES)
        step = -operator.solve(np.where(held, 0.0, internal).reshape(-1, 3))
        share, last = 1.0, residual
        while True:
            force, residual, internal = _balance(problem, u + share * step, held, chosen)
            if residual < last or share < 0.05:
                break
            share /= 2
        u = u + share * step
    everywhere = np.zeros(len(nodes))
    everywhere[active] = force
    slope = _slope(problem, held, chosen) if solid.material.is_linear else np.nan
    return _Pressed(everywhere, u, slope, residual)


def _slope(problem: ContactProblem, held: Mask, chosen: Index) -> float:
    """Return the reaction (N) to a unit dummy displacement of the chosen unknowns, per metre."""
    dummy = np.zeros(len(held))
    dummy[chosen] = -1.0
    dummy = _spread(problem.solid.stiffness, problem, held, dummy)
    return float(-(problem.solid.stiffness @ dummy)[chosen].sum())


def _balance(
    problem: ContactProblem, u: Array, held: Mask, chosen: Index
) -> tuple[Array, float, Array]:
    """Return the forces on the chosen unknowns, the relative imbalance and internal forces."""
    internal = problem.solid.internal_force(u).ravel()
    force = -internal[chosen]
    size = max(float(np.abs(force).sum()), 1e-300)
    return force, float(np.abs(internal[~held]).sum()) / size if len(chosen) else 0.0, internal


def _spread(
    stiffness: sparse.csr_matrix, problem: ContactProblem, held: Mask, given: Array
) -> Array:
    """Return the displacement (3n,) with the held unknowns as given and the rest unloaded."""
    operator = prepare_operator(stiffness, problem.index, held, _NO_NODES)
    pulled = np.where(held, 0.0, stiffness @ given)
    return given - operator.solve(pulled.reshape(-1, 3)).ravel()


def _solution(
    guess: InitialGuess,
    forces: ContactForces,
    planes: TangentPlanes,
    pressed: _Pressed,
    nodes: Index,
    loops: int,
    missed: float,
    done: bool,
) -> Solution:
    ended = ContactForces(
        forces.force, forces.gap, forces.approach, forces.active, forces.sets, done
    )
    residual = max(missed, pressed.residual)
    return Solution(
        guess.candidates, ended, planes, pressed.field[nodes], pressed.field, None, loops, residual
    )
