"""The lattice's contact at neighbouring poses, with its stiffness while the nodes stay in contact.

A femoral displacement v(x) = t + r cross x moves the contact's planes. Nodes in contact stay on
them; with n the femoral normals, lambda the forces along them and C the compliance of the nodes,

    dF = n dlambda + lambda dn,    n . (C dF - v) = 0,    dn = r cross n - G (v - n (n . v)),

G the change of the femoral normal along the surface: the femur slides over the nodes, which are
taken to move along the normal only. C is that of the linear operator. A material that has
softened is softer than this stiffness says, and nodes come into contact or leave it: the forces
are those of `evaluate`, the stiffness is a guide to where they vanish.
"""

from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.contact.lattice.initial_guess import lattice_start
from tkamb.contact.lattice.problem import ContactProblem, LatticeState
from tkamb.contact.pressing import Presses
from tkamb.contact.probe import Probe, ProbedContact, condyle_wrenches
from tkamb.contact.result import ContactResult, medial_points
from tkamb.contact.warm_start import Guess, WarmStart
from tkamb.geometry.frames import Array, Index
from tkamb.units import DEGREE

TURN_STEP = 5e-5
"""m: between the places where femoral normals are compared; well below a cell."""
LARGEST_EXTRAPOLATION = 2.0 * DEGREE
"""Farthest turn between two poses of which one's step is used for the other's: beyond it what the
extrapolated step leaves open (1 %) grows to some per cent of what the step changes."""


class FindsForces(Presses, Protocol):
    """A model that can leave out all but the forces."""

    def evaluate_from(
        self, state: Any, pose: Array, start: Guess | None = None, forces_only: bool = False
    ) -> tuple[ContactResult, WarmStart]:
        """See `tkamb.contact.lattice.model.CellContact`."""

    def press_from(
        self,
        state: Any,
        load: float,
        pose: Array,
        start: Guess | None = None,
        forces_only: bool = False,
    ) -> tuple[ContactResult, WarmStart]:
        """See `tkamb.contact.lattice.model.CellContact`."""


class LatticeProbe(Probe):
    """`evaluate` with the stiffness of what it found; see `tkamb.contact.probe.Probe`.

    Args:
        model: of the lattice family, nodes pressed along the femoral normal.
        state: what its `prepare` returned.
        start: an earlier result or warm start.
        accuracy: the model's tolerance, share of the contact force.
        rough: the model with a wider tolerance, for steps that are extrapolated.
    """

    def __init__(
        self,
        model: FindsForces,
        state: LatticeState,
        start: Guess | None,
        accuracy: float,
        rough: FindsForces,
    ) -> None:
        super().__init__(model, state, start)
        self._exact_model, self._accuracy, self._rough = model, accuracy, rough

    def evaluated(self, pose: Array) -> tuple[ContactResult, WarmStart]:
        """Return the forces at a pose; see `Probe`."""
        return self._exact_model.evaluate_from(self._state, pose, self.start, forces_only=True)

    def pressed(
        self,
        load: float,
        pose: Array,
        start: Guess | None,
        like: tuple[WarmStart, WarmStart] | None = None,
    ) -> tuple[ContactResult, WarmStart]:
        """Return the forces under a load; see `Probe`."""
        here, model = lattice_start(self._state, start), self._exact_model
        step = [lattice_start(self._state, each) for each in like or ()]
        if here is not None and like and _turn(like[0].pose, pose) <= LARGEST_EXTRAPOLATION:
            first, last = step
            if first is not None and last is not None:
                start, model = here.going_as(first, last, pose), self._rough
        return model.press_from(self._state, load, pose, start, forces_only=True)

    def seen(self, result: ContactResult, start: WarmStart | None = None) -> ProbedContact:
        """Return what a result says of the condyles, with their stiffness."""
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


def _turn(first: Array, second: Array) -> float:
    """Return the angle (rad) between the rotations of two poses."""
    return float(Rotation.from_matrix(first[:3, :3].T @ second[:3, :3]).magnitude())


def force_changes(state: LatticeState, result: ContactResult, moved: Array, nodes: Index) -> Array:
    """Return the change (m, 3, 6) of nodal forces per small displacement of the femur.

    Args:
        state: prepared contact.
        result: a contact that converged.
        moved: (c, 3) m, displacement of the contact nodes there.
        nodes: (m,) the contact nodes that carry.

    Returns:
        N per m of its point at the insert's origin, then N per rad.
    """
    problem = state.problem
    force = result.nodal_force[nodes]
    size = np.linalg.norm(force, axis=1)
    normals = force / size[:, None]
    where = problem.surface_points[nodes] + moved[nodes]
    response = state.compliance.among(nodes, nodes)
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

    Where a place lies beside the femoral component the normal is taken not to change.
    """
    gradient = np.zeros((len(where), 3, 3))
    for axis in (0, 2):
        step = TURN_STEP * np.eye(3)[axis]
        ahead, behind = (problem.femoral.over(where + s, pose)[1] for s in (step, -step))
        gradient[:, :, axis] = (ahead - behind) / (2 * TURN_STEP)
    gradient[~np.isfinite(gradient).all(axis=(1, 2))] = 0.0
    return gradient
