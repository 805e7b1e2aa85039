"""The reduction method: as many unknown loads as equations of motion, per frame.

    sum_k J_k(q)^T w_k x_k = RNEA(q, v, a) - sum_known J^T w_known

Reference: Komistek et al., J Biomech 38:215 (2005), doi:10.1016/j.jbiomech.2004.02.041.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.body.load import PointForces
from tkamb.geometry.frames import Array

LARGEST_CONDITION = 1e4
"""Above this condition number (unit columns) a frame counts as singular.

It grows as one over the arm d at which the patellar ligament passes the femorotibial contact:
7 to 9 m/d on the shipped knee, which has d = 43-45 mm and 148-218, and 9e2 at d = 9 mm.
1e4 is d = 0.8 mm, where an error of a millimetre in a line of action, which nobody excludes,
is more than the whole force.
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


def solve(names: Sequence[str], columns: Array, right: Array) -> Solution:
    """Solve the equations of motion of one frame for the magnitudes of the unknown loads.

    Args:
        names: of the k unknowns.
        columns: (k, k) generalised force of one unit of each.
        right: (k,) what they must add up to.

    Raises:
        ValueError: the system is not square.
    """
    if columns.shape != (len(right), len(right)):
        raise ValueError(f"{columns.shape[1]} unknown loads for {len(right)} equations")
    size = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(size > 0, size, 1.0)
    condition = float(np.linalg.cond(scaled))
    regular = bool(np.isfinite(condition) and condition < LARGEST_CONDITION)
    magnitudes = np.linalg.solve(scaled, right) / size if regular else np.full(len(right), np.nan)
    return Solution(dict(zip(names, magnitudes.tolist(), strict=True)), condition, regular)
