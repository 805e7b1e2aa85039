"""Where the material has lost forces that count: few cells, near the contact.

A cell's lost force falls with a power of its strain (4.5 for polyethylene), so most of the
insert is as good as linear. Passes look at the cells that count and at what of the factor
lies on their nodes' paths; all others are looked at once, at the end.
"""

from dataclasses import dataclass

import numpy as np

from tkamb.contact.lattice.problem import ContactProblem, Indices
from tkamb.geometry.frames import Array


@dataclass(frozen=True, eq=False)
class Region:
    """Some members (cells, springs) of a solid.

    Args:
        members: (k,) increasing.
        nodes: (m,) their nodes that are not held.
        fronts: (f,) what of the factor these nodes need, increasing.
        whole: these are all members.
    """

    members: Indices
    nodes: Indices
    fronts: Indices
    whole: bool

    @classmethod
    def of(cls, problem: ContactProblem, members: Indices) -> "Region":
        """Return the region of some members of the problem's solid."""
        scatter = problem.solid.scatter
        touched = np.zeros(scatter.nodes, bool)
        touched[scatter.members[members]] = True
        nodes = np.flatnonzero(touched & ~problem.held.reshape(-1, 3).all(axis=1))
        whole = len(members) == len(scatter.members)
        return cls(members, nodes, problem.operator.members_of(nodes), whole)

    @classmethod
    def everywhere(cls, problem: ContactProblem) -> "Region":
        """Return the region of all members."""
        return cls.of(problem, np.arange(len(problem.solid.scatter.members)))


def members_that_count(size: Array, allowed: float) -> Indices:
    """Return the members (k,) without the smallest, which together are below a bound.

    Args:
        size: (c,) norm of each member's lost force, N.
        allowed: N, root of the sum of squares of those left out.
    """
    order = np.argsort(size)
    left_out = int(np.searchsorted(np.cumsum(size[order] ** 2), allowed**2, side="right"))
    return np.sort(order[left_out:])
