"""What forces on the contact nodes do to each other, kept while it serves."""

from dataclasses import dataclass, field
from threading import Lock

import numpy as np

from tkamb.contact.lattice.linear.response import SINGLE, HalfResponse, unknowns_of
from tkamb.geometry.frames import Array, Index

MOST_STORED = 1500
"""Nodes of the stored compliance: 80 MB."""


@dataclass(frozen=True, eq=False)
class ContactResponse:
    """What forces on candidate nodes do.

    Args:
        half: response of the candidates and perhaps of more nodes, p in all.
        index: (m,) of the candidates among these.
        compliance: (3, m, 3, m) m/N, of the candidates: component and node moved, component
            and node pushed.
    """

    half: HalfResponse
    index: Index
    compliance: Array

    @classmethod
    def of(cls, half: HalfResponse) -> "ContactResponse":
        """Return the response of candidates that are all of the nodes of `half`."""
        return cls(half, np.arange(len(half.rank) // 3), by_component(half.compliance()))

    def push(self, force: Array, y: Array) -> None:
        """Add L⁻¹ of forces (m, 3), N, to y (in elimination order)."""
        self.half.apply(self._spread(force).ravel(), y)

    def displacement(self, y: Array) -> Array:
        """Return the candidates' displacement (m, 3), m, under the load whose L⁻¹ f is y."""
        return self.half.project(y).reshape(-1, 3)[self.index]

    def along(self, normals: Array) -> tuple[Array, Array]:
        """Return the compliance along normals (m, 3), and all that forces along them move.

        Returns:
            (m, m) m/N, and (3, m, m) m/N for `moved`.
        """
        n = np.ascontiguousarray(normals.T, dtype=self.compliance.dtype)
        pushed = np.einsum("aibj,bj->aij", self.compliance, n)
        return np.einsum("aij,ai->ij", pushed, n).astype(np.float64), pushed

    def moved(self, pushed: Array, force: Array) -> Array:
        """Return the candidates' displacement (m, 3), m, under forces (m,), N, along normals."""
        return np.einsum("aij,j->ia", pushed, force.astype(pushed.dtype))

    def _spread(self, values: Array) -> Array:
        """Return candidates' values (m, 3) on all the nodes (p, 3)."""
        spread = np.zeros((len(self.half.rank) // 3, 3))
        spread[self.index] = values
        return spread


def by_component(matrix: Array) -> Array:
    """Return a compliance (3p, 3p), ordered by node, as (3, p, 3, p)."""
    count = len(matrix) // 3
    return np.ascontiguousarray(matrix.reshape(count, 3, count, 3).transpose(1, 0, 3, 2))


@dataclass
class ComplianceCache:
    """The compliance among the nodes asked for last; what is at hand changes no answer.

    Args:
        whole: response of all contact nodes.
        nodes: (p,) contact nodes at hand, increasing.
        half: their response alone.
        compliance: (3, p, 3, p) m/N: component and node moved, component and node pushed.
    """

    whole: HalfResponse
    nodes: Index = field(default_factory=lambda: np.zeros(0, np.int64))
    half: HalfResponse | None = None
    compliance: Array = field(default_factory=lambda: np.zeros((3, 0, 3, 0), SINGLE))
    _lock: Lock = field(default_factory=Lock)

    def among(self, wanted: Index, spare: Index) -> ContactResponse:
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
        index = np.searchsorted(nodes, wanted)
        return ContactResponse(half, index, _taken(_taken(compliance, index, 1), index, 3))

    def moved(self, nodes: Index, pushed: Index, force: Array) -> Array:
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
            compliance = _taken(_taken(self.compliance, here, 1), there, 3)
        return np.einsum("aibj,jb->ia", compliance, force)

    def _take(self, nodes: Index) -> None:
        """Take nodes, with what is known of their compliance already."""
        half = self.whole.among(unknowns_of(nodes))
        _, here, there = np.intersect1d(nodes, self.nodes, True, True)
        new = np.setdiff1d(np.arange(len(nodes)), here, assume_unique=True)
        compliance: Array = np.empty((3, len(nodes), 3, len(nodes)), SINGLE)
        axes = np.arange(3)
        known, had = ((axes, index, axes, index) for index in (here, there))
        compliance[np.ix_(*known)] = self.compliance[np.ix_(*had)]
        rows = half.compliance(unknowns_of(new)).reshape(len(new), 3, len(nodes), 3)
        compliance[:, new] = rows.transpose(1, 0, 3, 2)
        compliance[..., new] = rows.transpose(3, 2, 1, 0)
        self.nodes, self.half, self.compliance = nodes, half, compliance


def _taken(values: Array, index: Index, axis: int) -> Array:
    """Return some entries along an axis; "clip" spares numpy a copy, all are in range."""
    return np.take(values, index, axis=axis, mode="clip")
