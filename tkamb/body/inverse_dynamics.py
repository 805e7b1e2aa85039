"""The reduction method: as many unknown loads as equations of motion, per frame.

    sum_k J_k(q)^T w_k x_k = RNEA(q, v, a) - sum_known J^T w_known

Reference: Komistek et al., J Biomech 38:215 (2005), doi:10.1016/j.jbiomech.2004.02.041.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.body.chain import ChainState
from tkamb.body.load import PointForces
from tkamb.geometry.frames import Array

LARGEST_CONDITION = 1e5
"""Above this condition number (unit columns) a frame counts as singular.

A regular knee lies between 1e2 and 1e3; a thousandth of the quadriceps' usual moment arm
takes it past the limit.
"""


@dataclass(frozen=True, eq=False)
class Unknown:
    """A load of unknown magnitude.

    Args:
        name: of the magnitude in the solution.
        loads: what one unit of it does to each link, insert frame.
    """

    name: str
    loads: tuple[PointForces, ...]


@dataclass(frozen=True, eq=False)
class Solution:
    """Magnitudes of the unknown loads at one frame; NaN where the system is singular.

    Args:
        values: name -> N or N·m.
        condition: 2-norm condition number of the matrix with unit columns.
        regular: whether the values may be used.
    """

    values: dict[str, float]
    condition: float
    regular: bool


def solve(state: ChainState, unknowns: Sequence[Unknown], known: Sequence[PointForces]) -> Solution:
    """Solve the equations of motion at one frame for the unknown loads.

    Args:
        state: chain at this frame (nv equations).
        unknowns: exactly nv of them.
        known: loads already known: ground reaction, ligaments.

    Raises:
        ValueError: the system is not square.
    """
    matrix = load_columns(state, unknowns)
    if matrix.shape[0] != matrix.shape[1]:
        raise ValueError(f"{matrix.shape[1]} unknown loads for {matrix.shape[0]} equations")
    right = state.inertial - sum(
        (state.generalised(load) for load in known), np.zeros(len(state.inertial))
    )
    size = np.linalg.norm(matrix, axis=0)
    condition = float(np.linalg.cond(matrix / np.where(size > 0, size, 1.0)))
    regular = bool(np.isfinite(condition) and condition < LARGEST_CONDITION)
    if regular:
        magnitudes = np.linalg.solve(matrix / size, right) / size
    else:
        magnitudes = np.full(len(unknowns), np.nan)
    names = [unknown.name for unknown in unknowns]
    return Solution(dict(zip(names, magnitudes.tolist(), strict=True)), condition, regular)


def load_columns(state: ChainState, unknowns: Sequence[Unknown]) -> Array:
    """Return the generalised force (nv, k) of one unit of each unknown."""
    columns = [
        np.sum([state.generalised(load) for load in unknown.loads], axis=0) for unknown in unknowns
    ]
    return np.stack(columns, axis=1)
