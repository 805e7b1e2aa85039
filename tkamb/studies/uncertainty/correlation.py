"""Inputs that err together: from [[uncertainty.correlation]] to correlated normal errors.

z = L x with x independent standard normal and L L^T the correlation matrix (Cholesky): a
Gaussian copula, since every input is a function of its own normal error. Reordering whole samples
until their ranks correlate (Iman & Conover 1982) would keep the strata of every input, but a
sample would then depend on how many there are; here it depends on its number alone.

References: Cario & Nelson, Modeling and generating random vectors with arbitrary marginal
distributions and correlation matrix, Northwestern University (1997); Iman & Conover, Commun Stat
Simul Comput 11:311 (1982), doi:10.1080/03610918208812265.
"""

from collections.abc import Sequence

import numpy as np

from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import Array
from tkamb.io.scene.uncertainty import CorrelationTable

TABLE = "[[uncertainty.correlation]]"
ROUNDING = 1e-10
"""An eigenvalue, or a remaining variance, above minus this counts as not negative."""


def correlation_root(tables: Sequence[CorrelationTable], names: Sequence[str]) -> Array:
    """Return L (d, d), lower triangular, with L L^T the correlation matrix of the inputs.

    Args:
        tables: the pairs that are correlated; all others are not.
        names: (d,) of the inputs that vary.

    Raises:
        InputError: an input that does not vary, a pair given twice, or no correlation matrix.
    """
    matrix = np.eye(len(names))
    for table in tables:
        row, column = (_place(name, names) for name in table.between)
        if matrix[row, column] != 0.0:
            raise InputError(f"'{table.between[0]}' and '{table.between[1]}' twice", TABLE)
        matrix[row, column] = matrix[column, row] = table.coefficient
    least = float(np.linalg.eigvalsh(matrix)[0])
    if least < -ROUNDING:
        raise InputError(
            f"do not give a correlation matrix (smallest eigenvalue {least:.3g})",
            TABLE,
            "give smaller coefficients, or those of the other pairs too",
        )
    return _cholesky(matrix)


def _place(name: str, names: Sequence[str]) -> int:
    if name in names:
        return names.index(name)
    raise InputError(
        f"'{name}' does not vary", TABLE, names_near(name, names, "the inputs that vary")
    )


def _cholesky(matrix: Array) -> Array:
    """Return L of a positive semi-definite matrix; a column of zeros where nothing is left."""
    root = np.zeros_like(matrix)
    for k in range(len(matrix)):
        rest = matrix[k, k] - root[k, :k] @ root[k, :k]
        if rest > ROUNDING:
            root[k, k] = np.sqrt(rest)
            root[k + 1 :, k] = (matrix[k + 1 :, k] - root[k + 1 :, :k] @ root[k, :k]) / root[k, k]
    return root
