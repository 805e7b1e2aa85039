"""What forces on the contact nodes do to each other, kept while it serves."""

from dataclasses import dataclass, field
from functools import cached_property
from threading import Lock

import numpy as np

from tkamb.contact.lattice.linear.response import SINGLE, HalfResponse, unknowns_of
from tkamb.geometry.frames import Array, Index


@dataclass(frozen=True)
class ComplianceSettings:
    """The stored compliance of candidate nodes."""

    max_nodes: int = 1500
    """Nodes of the stored compliance. Chosen: its matrix then takes 80 MB."""
    spare_nodes: int = 100
    """Nodes that may be added before the arrays have to grow. Chosen: it trades memory against
    copies."""


COMPLIANCE = ComplianceSettings()


@dataclass(frozen=True, eq=False)
class ContactResponse:
    """What forces on candidate nodes do.

    Args:
        whole: response of nodes of which the candidates are some.
        candidates: (m,) their positions among these.
        compliance: (3, m, 3, m) m/N, of the candidates: component and node moved, component
            and node pushed.
    """

    whole: HalfResponse
    candidates: Index
    compliance: Array

    @classmethod
    def of(cls, half: HalfResponse) -> "ContactResponse":
        """Return the response of candidates that are all of the nodes of `half`."""
        return cls(half, np.arange(len(half.rank) // 3), by_component(half.compliance()))

    @cached_property
    def _half(self) -> HalfResponse:
        """The response of the candidates alone; a linear material never asks for it."""
        return self.whole.among(unknowns_of(self.candidates))

    def push(self, force: Array, y: Array) -> None:
        """Add L⁻¹ of forces (m, 3), N, to y (in elimination order)."""
        self._half.apply(force.ravel(), y)

    def displacement(self, y: Array) -> Array:
        """Return the candidates' displacement (m, 3), m, under the load whose L⁻¹ f is y."""
        return self._half.project(y).reshape(-1, 3)

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


def by_component(matrix: Array) -> Array:
    """Return a compliance (3p, 3p), ordered by node, as (3, p, 3, p)."""
    count = len(matrix) // 3
    return np.ascontiguousarray(matrix.reshape(count, 3, count, 3).transpose(1, 0, 3, 2))


@dataclass
class ComplianceCache:
    """The compliance among the nodes asked for so far; what is at hand changes no answer.

    Args:
        whole: response of all contact nodes.
        nodes: (p,) contact nodes at hand, in the order in which they came.
        stored: (3, s, 3, s) m/N, s >= p: component and node moved, component and node pushed.
    """

    whole: HalfResponse
    nodes: Index = field(default_factory=lambda: np.zeros(0, np.int64))
    stored: Array = field(default_factory=lambda: np.zeros((3, 0, 3, 0), SINGLE))
    _lock: Lock = field(default_factory=Lock)

    def among(self, needed: Index, spare: Index) -> ContactResponse:
        """Return the response among contact nodes.

        Args:
            needed: (m,) increasing positions among the contact nodes.
            spare: a superset that is worked out when `needed` is not at hand, if not too many.
        """
        with self._lock:
            at = self._at(needed, spare)
            compliance = _taken(_taken(self.stored, at, 1), at, 3)
        return ContactResponse(self.whole, needed, compliance)

    def moved(self, nodes: Index, pushed: Index, force: Array) -> Array:
        """Return the displacement (m, 3), m, of contact nodes under forces on contact nodes.

        Args:
            nodes: (m,) increasing.
            pushed: (k,) increasing.
            force: (k, 3) N.
        """
        with self._lock:
            both = self._at(np.concatenate([nodes, pushed]), np.union1d(nodes, pushed))
            columns, rows = both[: len(nodes)], both[len(nodes) :]
            compliance = _taken(_taken(self.stored, columns, 1), rows, 3)
        return np.einsum("aibj,jb->ia", compliance, force)

    def _at(self, needed: Index, spare: Index) -> Index:
        """Return where nodes (m,) are stored; what is not at hand is worked out, spare and all."""
        place = np.full(len(self.whole.rank) // 3, -1)
        place[self.nodes] = np.arange(len(self.nodes))
        if (place[needed] < 0).any():
            if len(spare) > COMPLIANCE.max_nodes:
                spare = np.unique(needed)
            if len(self.nodes) + np.count_nonzero(place[spare] < 0) > COMPLIANCE.max_nodes:
                self.nodes, place[:] = self.nodes[:0], -1
            self._take(spare[place[spare] < 0])
            place[self.nodes] = np.arange(len(self.nodes))
        return place[needed]

    def _take(self, nodes: Index) -> None:
        """Take more nodes."""
        had, new = len(self.nodes), len(nodes)
        count = had + new
        if count > self.stored.shape[1]:
            larger: Array = np.empty(
                (3, count + COMPLIANCE.spare_nodes, 3, count + COMPLIANCE.spare_nodes), SINGLE
            )
            larger[:, :had, :, :had] = self.stored[:, :had, :, :had]
            self.stored = larger
        self.nodes = np.concatenate([self.nodes, nodes])
        half = self.whole.among(unknowns_of(self.nodes))
        rows = half.compliance(unknowns_of(np.arange(had, count))).reshape(new, 3, count, 3)
        self.stored[:, had:count, :, :count] = rows.transpose(1, 0, 3, 2)
        self.stored[:, :count, :, had:count] = rows.transpose(3, 2, 1, 0)


def _taken(values: Array, index: Index, axis: int) -> Array:
    """Return some entries along an axis; "clip" spares numpy a copy, all are in range."""
    return np.take(values, index, axis=axis, mode="clip")
