"""Whether an operator inverts the stiffness of its solid, asked of the cells themselves.

Nothing of the factorisation enters: K u is summed cell by cell from the solid's own matrices.
"""

import numpy as np

from tkamb.contact.lattice.operator import ElasticOperator
from tkamb.contact.lattice.solid import Solid
from tkamb.geometry.frames import Array

SEED = 20_240_501


def operator_error(operator: ElasticOperator, solid: Solid) -> float:
    """Return how far an operator is from its solid's stiffness K, relative.

    The largest of

        |K ũ - f| / |f|            f = K u of a random u, ũ = L⁻ᵀ L⁻¹ f
        |fᵀũ - ũᵀK ũ| / fᵀũ        f pressing on every contact node
        |Z g - L⁻¹ E g| / |L⁻¹ E g|    g random on the contact nodes

    with K summed from the cells. A random u is as rough as the grid, so that f is as large as
    K and u allow and float32 leaves 1e-6 of it whatever the condition of K; the second looks at
    the soft, smooth displacements, and the third holds the stored response against the factor.
    Nothing of factor or response is left out by random numbers.

    Args:
        operator: to be looked at.
        solid: that it should be of.
    """
    chance = np.random.default_rng(SEED)
    nodes, shape = operator.contact_nodes, solid.nodes.shape
    pressed, touched = np.zeros(shape), np.zeros(shape)
    pressed[nodes, 1] = -1.0
    touched[nodes] = chance.normal(size=(len(nodes), 3))
    moved = np.where(operator.free.reshape(-1, 3), chance.normal(size=shape), 0.0)
    force = _carried(operator, solid, moved)
    missing = _carried(operator, solid, operator.solve(force)) - force
    sunk = operator.solve(pressed)
    work, energy = (float((f * sunk).sum()) for f in (pressed, _carried(operator, solid, sunk)))
    directly = operator.start(touched)
    stored = np.zeros_like(directly)
    operator.half.apply(touched[nodes].ravel(), stored)
    return max(
        _ratio(np.linalg.norm(missing), np.linalg.norm(force)),
        _ratio(work - energy, work),
        _ratio(np.linalg.norm(stored - directly), np.linalg.norm(directly)),
    )


def _carried(operator: ElasticOperator, solid: Solid, displacement: Array) -> Array:
    """Return K u, N, (n, 3), on the free unknowns; 0 where held."""
    return np.where(operator.free.reshape(-1, 3), solid.linear_force(displacement), 0.0)


def _ratio(part: float | np.floating, whole: float | np.floating) -> float:
    """Return |part / whole|; inf where that is no number, so that it passes no comparison."""
    value = abs(float(part)) / max(abs(float(whole)), 1e-300)
    return value if np.isfinite(value) else float("inf")
