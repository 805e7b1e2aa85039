"""The lattice's contact at neighbouring poses, and its stiffness for an unchanged active set.

A small femoral displacement v(x) = t + r cross x moves the femoral planes, and the nodes in contact
stay on them. With the femoral normals n, the forces lambda along them, and the compliance C,

    dF = n dlambda + lambda dn,    n . (C dF - v) = 0,    dn = r cross n - G (v - n (n . v)).

G is the gradient of the femoral normal along the surface. The nodes are assumed to move along the
normal only, with C of the linear material and a constant active set. The real contact differs, so
the forces come from `evaluate`, and the stiffness only gives the direction of a search.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tkamb.contact.lattice.initial_guess import LatticeStart, lattice_start, step_between
from tkamb.contact.lattice.problem import ContactProblem, LatticeState
from tkamb.contact.model import LoadedPoints, Probe, ProbedContact, condyle_wrenches
from tkamb.contact.result import ContactResult, Guess, WarmStart, medial_points
from tkamb.geometry.frames import Array, Index

if TYPE_CHECKING:
    from tkamb.contact.lattice.model import CellContact

TURN_STEP = 5e-5
"""m: step of the finite difference of femoral normals. It is well below a cell."""
REGION_HOLDS_WITHIN = 0.1
"""Cells: largest distance from the last pose at which the whole solid was evaluated. Within it only
the region is evaluated, in half the time. The residual of the whole solid is then at most 1.2 times
the tolerance (`tests/test_lattice_probe.py`)."""
REGION_HOLDS_TO = 1.1
"""1: largest ratio of the contact force to that of the last evaluation of the whole solid."""


class LatticeProbe(Probe):
    """Contact forces and their stiffness at neighbouring poses; see `tkamb.contact.model.Probe`.

    `accuracy` is the model's tolerance, relative to the contact force. The model's contact forces
    act along the femoral normal.
    """

    def __init__(
        self, model: "CellContact", state: LatticeState, start: Guess | None, accuracy: float
    ) -> None:
        super().__init__(model, state, start)
        self._lattice_model, self._accuracy = model, accuracy
        self._measured: tuple[Array, float] | None = None
        """Last pose at which the whole solid was evaluated, and norm of the forces there, N."""
        self._pressed: tuple[LatticeStart, LatticeStart] | None = None
        """States before and after the last press near its start."""

    def evaluated(self, pose: Array) -> tuple[ContactResult, WarmStart]:
        """Return the contact at a pose, and a warm start.

        Near the last pose at which the whole solid was evaluated, only the region is evaluated.
        """
        model = self._lattice_model
        if self._measured is not None and self._near(self._measured[0], pose):
            result, start = model.evaluate_from(self._state, pose, self.start, True)
            if np.linalg.norm(result.nodal_force) <= REGION_HOLDS_TO * self._measured[1]:
                return result, start
        result, start = model.evaluate_from(self._state, pose, self.start)
        self._measured = pose, float(np.linalg.norm(result.nodal_force))
        return result, start

    def pressed(
        self, load: float, pose: Array, start: Guess | None
    ) -> tuple[ContactResult, WarmStart]:
        """Return the contact and a warm start under a load (N); only the forces are correct.

        Near the pose of `start`, whose whole solid was evaluated, only the region is evaluated.
        """
        near = start is not None and self._near(start.pose, pose)
        begin = begun = lattice_start(self._state, start)
        if begun is not None and near and self._pressed is not None:
            begin = replace(begun.plus(*self._pressed), before=None)
        result, end = self._lattice_model.press_from(
            self._state, load, pose, start if begin is None else begin, near
        )
        solved = lattice_start(self._state, end)
        self._pressed = (begun, solved) if begun and solved and near else None
        return result, end

    def _near(self, measured: Array, pose: Array) -> bool:
        # The step has no height: a limit on the forces covers its change.
        size = float(np.linalg.norm(step_between(measured, pose)))
        return size <= REGION_HOLDS_WITHIN * float(self._state.lattice.spacing.min())

    def seen(self, result: ContactResult, start: WarmStart | None = None) -> ProbedContact:
        """Return the condyles' forces of a result, with their stiffness."""
        nodes = np.flatnonzero(result.nodal_force.any(axis=1))
        solution = lattice_start(self._state, start)
        # The search of equilibrium takes the tangent of a linear material as exact.
        exact = self._state.problem.solid.material.is_linear
        if not len(nodes):
            return ProbedContact({}, tangent=True, exact=exact, accuracy=self._accuracy)
        if solution is None:
            condyles = condyle_wrenches(result, self._state.pair.split)
            return ProbedContact(condyles, accuracy=self._accuracy)
        solved = SolvedContact(result, solution, nodes)
        change = force_changes(self._state, result, solution.displacement, nodes)
        return self._with_changes(solved, change, exact, with_centre=False)

    def exact_tangent(self, contact: ProbedContact) -> ProbedContact:
        """Return a contact of this probe with the tangent of `exact_tangent.py`."""
        if not isinstance(contact, LatticeContact):
            return contact
        from tkamb.contact.lattice.exact_tangent import exact_force_changes

        solved = contact.solved
        change = exact_force_changes(self._state, solved.result, solved.start, solved.nodes)
        return self._with_changes(solved, change, exact=True, with_centre=True)

    def loaded_points(self, pose: Array, contact: ProbedContact, slopes: bool) -> LoadedPoints:
        """Return the pressures of the loaded nodes; their derivative is that of `exact_tangent.py`.

        A node's area is constant, so that its pressure changes as its force. `contact` is one of
        this probe.
        """
        if not contact.condyles:
            return LoadedPoints(np.empty(0), np.empty(0), np.empty(0, bool), np.empty((0, 6)))
        assert isinstance(contact, LatticeContact)
        solved = contact.solved
        result, nodes = solved.result, solved.nodes
        pressure, area = result.pressure[nodes], result.area[nodes]
        medial = medial_points(result.points[nodes], pose, self._state.pair.split)
        if not slopes:
            return LoadedPoints(pressure, area, medial, None)
        from tkamb.contact.lattice.exact_tangent import exact_force_changes

        change = exact_force_changes(self._state, result, solved.start, nodes)
        force = result.nodal_force[nodes]
        along = force / np.linalg.norm(force, axis=1)[:, None]
        if self._lattice_model.pressure_rule == "source":
            along = -result.normals[nodes]
        slope = np.einsum("ia,iak->ik", along, change) / area[:, None]
        return LoadedPoints(pressure, area, medial, slope)

    def _with_changes(
        self, solved: "SolvedContact", change: Array, exact: bool, with_centre: bool
    ) -> ProbedContact:
        """Return the condyles of a result with the changes (m, 3, 6) of the forces on its nodes."""
        result, nodes = solved.result, solved.nodes
        condyles = condyle_wrenches(result, self._state.pair.split)
        points, force = result.points[nodes], result.nodal_force[nodes]
        size = np.linalg.norm(force, axis=1)
        medial = medial_points(points, result.pose, self._state.pair.split)
        for side, on_side in (("medial", medial), ("lateral", ~medial)):
            if side in condyles:
                part = change[on_side]
                moment = np.cross(points[on_side, :, None], part, axis=1)
                stiffness = np.vstack([part.sum(axis=0), moment.sum(axis=0)])
                condyles[side] = replace(condyles[side], stiffness=stiffness)
                if with_centre:  # the centre is sum(x |f|) / sum(|f|) over the nodes
                    away = points[on_side] - condyles[side].centre
                    growth = np.einsum("ia,iak->ik", force[on_side], part)
                    growth /= size[on_side, None]
                    slope = away.T @ growth / size[on_side].sum()
                    condyles[side] = replace(condyles[side], centre_slope=slope)
        return LatticeContact(
            condyles, tangent=True, exact=exact, accuracy=self._accuracy, solved=solved
        )


@dataclass(frozen=True, eq=False)
class SolvedContact:
    """A contact that has converged, its warm start, and its loaded contact nodes (m,)."""

    result: ContactResult
    start: LatticeStart
    nodes: Index


@dataclass(frozen=True, eq=False, kw_only=True)
class LatticeContact(ProbedContact):
    """The wrenches of a loaded contact, with the solution that its exact tangent needs."""

    solved: SolvedContact


def force_changes(
    state: LatticeState, result: ContactResult, displacement: Array, nodes: Index
) -> Array:
    """Return the change (m, 3, 6) of nodal forces per small displacement of the femur.

    `displacement` (c, 3), m, is that of all contact nodes. Else as `exact_force_changes`.
    """
    problem = state.problem
    force = result.nodal_force[nodes]
    size = np.linalg.norm(force, axis=1)
    normals = force / size[:, None]
    positions = problem.surface_points[nodes] + displacement[nodes]
    response = state.compliance.among(nodes)
    # v of the formulas, per unit of the six displacements of the femur.
    femoral = np.zeros((len(nodes), 3, 6))
    femoral[:, :, :3] = np.eye(3)
    femoral[:, :, 3:] = np.cross(np.eye(3)[None], positions[:, None, :]).transpose(0, 2, 1)
    along_normal = np.einsum("ij,ijk->ik", normals, femoral)
    normal_change = np.zeros_like(femoral)
    normal_change[:, :, 3:] = np.cross(np.eye(3)[None], normals[:, None, :]).transpose(0, 2, 1)
    sliding = femoral - normals[:, :, None] * along_normal[:, None, :]
    normal_change -= _normal_gradient(problem, positions, result.pose) @ sliding
    turned_force = size[:, None, None] * normal_change
    by_turning = np.einsum("aibj,jbk->iak", response.compliance, turned_force, optimize=True)
    along, _ = response.along(normals)
    right_side = along_normal - np.einsum("ij,ijk->ik", normals, by_turning)
    return normals[:, :, None] * np.linalg.solve(along, right_side)[:, None, :] + turned_force


def _normal_gradient(problem: ContactProblem, positions: Array, pose: Array) -> Array:
    """Return the change (m, 3, 3) of the femoral normal per m along x, y and z; 0 along y.

    It is 0 where the femoral surface ends.
    """
    gradient = np.zeros((len(positions), 3, 3))
    for axis in (0, 2):
        step = TURN_STEP * np.eye(3)[axis]
        ahead, behind = (problem.femoral.over(positions + s, pose)[1] for s in (step, -step))
        gradient[:, :, axis] = (ahead - behind) / (2 * TURN_STEP)
    gradient[~np.isfinite(gradient).all(axis=(1, 2))] = 0.0
    return gradient
