"""Which contact nodes can be touched at a pose, and their compliance, kept while it serves."""

from dataclasses import dataclass, field
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.memory import Remembered
from tkamb.contact.lattice.problem import ContactProblem
from tkamb.contact.lattice.response import HalfResponse
from tkamb.contact.lattice.solver import Start
from tkamb.geometry.frames import Array

Indices = NDArray[np.int64]

MARGIN = 0.25
"""Nodes count as candidates this share of the depth beyond first touch."""
SPARE = 1.6
"""The stored compliance covers nodes down to this many times the depth asked for."""
MOST_STORED = 1500
"""Nodes of the stored compliance: 160 MB."""


@dataclass
class CompliancePool:
    """The compliance (3m, 3m) of the nodes asked for last; a cache that changes no answer."""

    half: HalfResponse
    nodes: Indices = field(default_factory=lambda: np.zeros(0, np.int64))
    matrix: Array = field(default_factory=lambda: np.zeros((0, 0)))
    _lock: Lock = field(default_factory=Lock)

    def among(self, wanted: Indices, spare: Indices) -> Array:
        """Return the compliance (3m, 3m), m/N, among contact nodes.

        Args:
            wanted: (m,) increasing positions among the contact nodes.
            spare: a superset that is worked out when `wanted` is not at hand, if not too many.
        """
        with self._lock:
            nodes, matrix = self.nodes, self.matrix
            if not np.isin(wanted, nodes, assume_unique=True).all():
                nodes = spare if len(spare) <= MOST_STORED else wanted
                matrix = self.half.compliance((3 * nodes[:, None] + np.arange(3)).ravel())
                self.nodes, self.matrix = nodes, matrix
        place = np.searchsorted(nodes, wanted)
        unknowns = (3 * place[:, None] + np.arange(3)).ravel()
        return matrix if len(wanted) == len(nodes) else matrix[np.ix_(unknowns, unknowns)]


def guessed_depth(problem: ContactProblem, gaps: Array, areas: Array, load: float) -> float:
    """Return a depth (m) at which an elastic foundation of modulus E would carry the load.

    Args:
        problem: for the material and the thickness under each node.
        gaps: (c,) vertical gaps, m.
        areas: (c,) m².
        load: N.
    """
    stiffness = problem.solid.material.young_modulus * areas
    stiffness = stiffness / np.maximum(problem.surface_points[:, 1], 1e-3)
    order = np.argsort(gaps)
    order = order[np.isfinite(gaps[order])]
    height, k = gaps[order], stiffness[order]
    reached = np.cumsum(k) * height - np.cumsum(k * height)
    last = int(np.searchsorted(reached, load))
    total, moment = np.cumsum(k), np.cumsum(k * height)
    last = max(min(last, len(order)) - 1, 0)
    return float((load + moment[last]) / total[last] - height[0])


def choose_start(
    pool: CompliancePool,
    gaps: Array,
    depth: float,
    at_pose: bool,
    touched: NDArray[np.bool_] | None,
    earlier: Remembered | None,
) -> Start:
    """Return candidates, their compliance and a first active set.

    Args:
        pool: where compliances come from.
        gaps: (c,) vertical gaps, m.
        depth: m, how deep the femoral component may go below the lowest gap.
        at_pose: the femoral component stays at the pose: candidates overlap it already.
        touched: (c,) nodes in contact in a neighbouring solution, or None.
        earlier: where a neighbouring solution ended, or None.
    """
    lowest = float(gaps.min())
    reach = lowest + (1 + MARGIN) * depth
    nodes = np.flatnonzero(gaps <= reach)
    spare = np.flatnonzero(gaps <= lowest + SPARE * depth)
    if len(pool.nodes):
        both = np.union1d(spare, pool.nodes)
        spare = both if len(both) <= MOST_STORED else spare
    level = 0.0 if at_pose else lowest + 0.6 * depth
    active = gaps[nodes] < level
    if touched is not None and touched[nodes].any():
        active = touched[nodes]
    lost = None if earlier is None else earlier.lost
    moved = None if earlier is None else earlier.moved[nodes]
    return Start(nodes, pool.among(nodes, spare), active, lost, moved, reach)
