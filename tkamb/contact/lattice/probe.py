"""The lattice's contact at neighbouring poses, and its stiffness for an unchanged active set.

A femoral displacement v(x) = t + r cross x moves the contact's planes. Nodes in contact stay on
them; with n the femoral normals, lambda the forces along them and C the compliance of the nodes,

    dF = n dlambda + lambda dn,    n . (C dF - v) = 0,    dn = r cross n - G (v - n (n . v)),

where G is the gradient of the femoral normal along the surface. The femur slides over the nodes,
which are assumed to move along the normal only. C is the compliance of the linear operator. A
softened material is softer than this stiffness, and nodes may come into contact or leave it. So
the forces come from `evaluate`, and the stiffness only gives the direction of the search.
"""

from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from tkamb.contact.lattice.initial_guess import lattice_start
from tkamb.contact.lattice.problem import ContactProblem, LatticeState
from tkamb.contact.model import Probe, ProbedContact, condyle_wrenches
from tkamb.contact.pressing import Presses
from tkamb.contact.result import ContactResult, Guess, WarmStart, medial_points
from tkamb.geometry.frames import Array, Index

TURN_STEP = 5e-5
"""m: step of the finite difference of femoral normals. Chosen: well below a cell."""
REGION_HOLDS_WITHIN = 0.1
"""Cells: largest distance from the pose at which the whole solid was evaluated last. Within this
distance only the region of its solution is evaluated, in half the time. The residual of the whole
solid then stays within 1.2 times the tolerance (`tests/test_lattice_probe.py`)."""
REGION_HOLDS_TO = 1.1
"""1: largest ratio of the contact forces to those at that pose."""
LEVER_ARM = 0.03
"""m, from the femoral axis to the contact: turns a rotation into a distance."""


class FindsForces(Presses, Protocol):
    """A contact model that can compute the forces alone."""

    def evaluate_from(
        self, state: Any, pose: Array, start: Guess | None = None, forces_only: bool = False
    ) -> tuple[ContactResult, WarmStart]:
        """See `tkamb.contact.lattice.model.CellContact`."""


class LatticeProbe(Probe):
    """Contact forces and their stiffness at neighbouring poses; see `tkamb.contact.model.Probe`.

    Args:
        model: lattice model whose nodes are pressed along the femoral normal.
        state: what its `prepare` returned.
        start: an earlier result or warm start.
        accuracy: 1, the model's tolerance, as a share of the contact force.
    """

    def __init__(
        self, model: FindsForces, state: LatticeState, start: Guess | None, accuracy: float
    ) -> None:
        super().__init__(model, state, start)
        self._finds, self._accuracy = model, accuracy
        self._measured: tuple[Array, float] | None = None
        """Pose at which the whole solid was evaluated last, and norm of the forces there, N."""

    def evaluated(self, pose: Array) -> tuple[ContactResult, WarmStart]:
        """Return the contact at a pose and the start of the next evaluation.

        Near the pose at which the whole solid was evaluated last, only the region is evaluated.
        """
        if self._measured is not None:
            way = (pose - self._measured[0])[:3] * [LEVER_ARM, LEVER_ARM, LEVER_ARM, 1.0]
            way[1, 3] = 0.0  # the limit on the forces covers a change of height
            if np.linalg.norm(way) <= REGION_HOLDS_WITHIN * self._state.lattice.spacing.min():
                result, start = self._finds.evaluate_from(self._state, pose, self.start, True)
                if np.linalg.norm(result.nodal_force) <= REGION_HOLDS_TO * self._measured[1]:
                    return result, start
        result, start = self._finds.evaluate_from(self._state, pose, self.start)
        self._measured = pose, float(np.linalg.norm(result.nodal_force))
        return result, start

    def seen(self, result: ContactResult, start: WarmStart | None = None) -> ProbedContact:
        """Return the condyles' forces of a result, with their stiffness."""
        condyles = condyle_wrenches(result, self._state.pair.split)
        exact = self._state.problem.solid.material.is_linear
        nodes = np.flatnonzero(result.nodal_force.any(axis=1))
        solution = lattice_start(self._state, start)
        if not len(nodes):
            return ProbedContact(condyles, tangent=True, exact=exact, accuracy=self._accuracy)
        if solution is None:
            return ProbedContact(condyles, accuracy=self._accuracy)
        change = force_changes(self._state, result, solution.moved, nodes)
        points = result.points[nodes]
        medial = medial_points(points, result.pose, self._state.pair.split)
        for side, own in (("medial", medial), ("lateral", ~medial)):
            if side in condyles:
                part = change[own]
                moment = np.cross(points[own, :, None], part, axis=1)
                stiffness = np.vstack([part.sum(axis=0), moment.sum(axis=0)])
                condyles[side] = replace(condyles[side], stiffness=stiffness)
        return ProbedContact(condyles, tangent=True, exact=exact, accuracy=self._accuracy)


def force_changes(state: LatticeState, result: ContactResult, moved: Array, nodes: Index) -> Array:
    """Return the change (m, 3, 6) of nodal forces per small displacement of the femur.

    Args:
        state: prepared contact.
        result: a contact that converged.
        moved: (c, 3) m, displacement of the contact nodes there.
        nodes: (m,) loaded contact nodes.

    Returns:
        Columns 0 to 2: N per m of translation of the femoral point at the insert's origin.
        Columns 3 to 5: N per rad of rotation about this point.
    """
    problem = state.problem
    force = result.nodal_force[nodes]
    size = np.linalg.norm(force, axis=1)
    normals = force / size[:, None]
    where = problem.surface_points[nodes] + moved[nodes]
    response = state.compliance.among(nodes)
    femoral = np.zeros((len(nodes), 3, 6))
    femoral[:, :, :3] = np.eye(3)
    femoral[:, :, 3:] = np.cross(np.eye(3)[None], where[:, None, :]).transpose(0, 2, 1)
    towards = np.einsum("ij,ijk->ik", normals, femoral)
    turned = np.zeros_like(femoral)
    turned[:, :, 3:] = np.cross(np.eye(3)[None], normals[:, None, :]).transpose(0, 2, 1)
    sliding = femoral - normals[:, :, None] * towards[:, None, :]
    turned -= _normal_gradient(problem, where, result.pose) @ sliding
    swung = size[:, None, None] * turned
    yielded = np.einsum("aibj,jbk->iak", response.compliance, swung, optimize=True)
    along, _ = response.along(normals)
    right = towards - np.einsum("ij,ijk->ik", normals, yielded)
    return normals[:, :, None] * np.linalg.solve(along, right)[:, None, :] + swung


def _normal_gradient(problem: ContactProblem, where: Array, pose: Array) -> Array:
    """Return the change (m, 3, 3) of the femoral normal per m along x, y and z; 0 along y.

    Where a neighbouring point lies beside the femoral component, the change is taken as 0.
    """
    gradient = np.zeros((len(where), 3, 3))
    for axis in (0, 2):
        step = TURN_STEP * np.eye(3)[axis]
        ahead, behind = (problem.femoral.over(where + s, pose)[1] for s in (step, -step))
        gradient[:, :, axis] = (ahead - behind) / (2 * TURN_STEP)
    gradient[~np.isfinite(gradient).all(axis=(1, 2))] = 0.0
    return gradient
