"""Which contact nodes can be touched at a pose, and their response, kept while it serves."""

from dataclasses import dataclass, field
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.problem import ContactProblem, Footing
from tkamb.contact.lattice.region import Region
from tkamb.contact.lattice.response import SINGLE, ContactResponse, HalfResponse, unknowns_of
from tkamb.contact.lattice.solver import Start
from tkamb.geometry.frames import Array

Indices = NDArray[np.int64]

MARGIN = 0.25
"""Nodes count as candidates this share of the depth beyond first touch."""
SPARE = 1.6
"""The stored response covers nodes down to this many times the depth asked for."""
MOST_STORED = 1500
"""Nodes of the stored response: 80 MB of compliance."""


@dataclass(frozen=True, eq=False)
class WarmStart:
    """Where a solution ended: what a result carries for the next solution of the same problem.

    Args:
        problem: whose solution it was; it serves no other.
        lost: (n, 3) h, N, or None for a linear material.
        moved: (c, 3) m, displacement of the contact nodes that were candidates, else 0.
        depth: m, how far the femoral component went below the lowest contact node.
        region: outside of which `lost` is zero, or None.
    """

    problem: ContactProblem
    lost: Array | None
    moved: Array
    depth: float
    region: Region | None


@dataclass
class ResponsePool:
    """The response of the nodes asked for last; a cache that changes no answer.

    Args:
        whole: response of all contact nodes.
        nodes: (p,) contact nodes at hand, increasing.
        half: their response alone.
        compliance: (3, p, 3, p) m/N: component and node moved, component and node pushed.
    """

    whole: HalfResponse
    nodes: Indices = field(default_factory=lambda: np.zeros(0, np.int64))
    half: HalfResponse | None = None
    compliance: Array = field(default_factory=lambda: np.zeros((3, 0, 3, 0), SINGLE))
    _lock: Lock = field(default_factory=Lock)

    def among(self, wanted: Indices, spare: Indices) -> ContactResponse:
        """Return the response among contact nodes.

        Args:
            wanted: (m,) increasing positions among the contact nodes.
            spare: a superset that is worked out when `wanted` is not at hand, if not too many.
        """
        with self._lock:
            if self.half is None or not np.isin(wanted, self.nodes, assume_unique=True).all():
                self._take(spare if len(spare) <= MOST_STORED else wanted)
            nodes, half, compliance = self.nodes, self.half, self.compliance
        assert half is not None
        place = np.searchsorted(nodes, wanted)
        return ContactResponse(half, place, _taken(_taken(compliance, place, 1), place, 3))

    def moved(self, nodes: Indices, pushed: Indices, force: Array) -> Array:
        """Return the displacement (m, 3), m, of contact nodes under forces on contact nodes.

        Args:
            nodes: (m,) increasing.
            pushed: (k,) increasing.
            force: (k, 3) N.
        """
        with self._lock:
            wanted = np.union1d(nodes, pushed)
            if not np.isin(wanted, self.nodes, assume_unique=True).all():
                both = np.union1d(wanted, self.nodes)
                self._take(both if len(both) <= MOST_STORED else wanted)
            here, there = np.searchsorted(self.nodes, nodes), np.searchsorted(self.nodes, pushed)
            axes = np.arange(3)
            compliance = self.compliance[np.ix_(axes, here, axes, there)]
        return np.asarray(np.einsum("aibj,jb->ia", compliance, force))

    def _take(self, nodes: Indices) -> None:
        """Take nodes, with what is known of their compliance already."""
        half = self.whole.among(unknowns_of(nodes))
        _, here, there = np.intersect1d(nodes, self.nodes, True, True)
        new = np.setdiff1d(np.arange(len(nodes)), here, assume_unique=True)
        compliance: Array = np.empty((3, len(nodes), 3, len(nodes)), SINGLE)
        axes = np.arange(3)
        known, had = ((axes, places, axes, places) for places in (here, there))
        compliance[np.ix_(*known)] = self.compliance[np.ix_(*had)]
        rows = half.compliance(unknowns_of(new)).reshape(len(new), 3, len(nodes), 3)
        compliance[:, new] = rows.transpose(1, 0, 3, 2)
        compliance[..., new] = rows.transpose(3, 2, 1, 0)
        self.nodes, self.half, self.compliance = nodes, half, compliance


def _taken(values: Array, places: Indices, axis: int) -> Array:
    """Return some places along an axis; "clip" spares numpy a copy, all are in range."""
    return np.take(values, places, axis=axis, mode="clip")


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
    pool: ResponsePool,
    gaps: Array,
    foot: Footing,
    depth: float,
    at_pose: bool,
    touched: NDArray[np.bool_] | None,
    earlier: WarmStart | None,
) -> Start:
    """Return candidates, their response and a first active set.

    Args:
        pool: where responses come from.
        gaps: (c,) vertical gaps, m.
        foot: of all contact nodes, undeformed.
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
    response = pool.among(nodes, spare)
    if earlier is None:
        return Start(nodes, response, active, foot.part(nodes), reach=reach)
    moved, region = earlier.moved[nodes], earlier.region
    own = foot.part(nodes)
    return Start(nodes, response, active, own, earlier.lost, moved, reach, region)
