"""Samples of standard normal inputs, independent or correlated.

Sample n depends on its number alone, not on the number of samples. More samples therefore keep the
earlier ones, and the order in which workers finish does not matter.

Correlated inputs ([[uncertainty.correlation]]): z = L x, with x independent standard normal and
L L^T the correlation matrix (Cholesky). This is a Gaussian copula, because every input is a
function of its own normal error. The method of Iman & Conover (1982) keeps the strata of every
input, but its samples depend on their number.

References: Cario & Nelson, Modeling and generating random vectors with arbitrary marginal
distributions and correlation matrix, Northwestern University (1997); Iman & Conover, Commun Stat
Simul Comput 11:311 (1982), doi:10.1080/03610918208812265.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

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


Method = Literal["lhs", "sobol"]
BLOCK = 64
"""Samples of one Latin hypercube; the next ones make the next hypercube."""
SMALLEST_TAIL = 1e-9
"""Smallest probability that is mapped to a normal quantile: Sobol' points may be 0, whose quantile
is not finite."""
NOISE = 1
"""Number that separates the seeds of the noise from those of the hypercubes."""


@dataclass(frozen=True, eq=False)
class Point:
    """Where in the space of inputs a sample lies.

    Args:
        normal: (d,) standard normal, one per input.
        noise_of: (d,) numbers of the samples whose noise per frame each input has; None: no
            noise, the whole deviation of a pose is the same in all frames.
    """

    normal: Array
    noise_of: tuple[int, ...] | None

    @classmethod
    def of(cls, number: int, normal: Array) -> "Point":
        """Return the point of a sample with its own noise."""
        return cls(normal, (number,) * len(normal))


def crossed_points(first: Array, second: Array) -> list[Point]:
    """Return the points of Saltelli's design: A, B, and A with each column from B.

    A point's noise goes with its column. Order: n of A, n of B, then n per input.

    Args:
        first: (n, d) standard normal, A.
        second: (n, d) of B.

    Reference: Saltelli et al., Comput Phys Commun 181:259 (2010),
    doi:10.1016/j.cpc.2009.09.018.
    """
    count, dimensions = first.shape
    points = [Point.of(n, one) for n, one in enumerate(np.concatenate([first, second]))]
    for i in range(dimensions):
        for n in range(count):
            normal, own = first[n].copy(), [n] * dimensions
            normal[i], own[i] = second[n, i], count + n
            points.append(Point(normal, tuple(own)))
    return points


def one_at_a_time(dimensions: int) -> list[Point]:
    """Return the points of a screening: none moved, then each input by -1 and +1 deviation."""
    steps = np.repeat(np.eye(dimensions), 2, axis=0)
    steps[::2] *= -1.0
    return [Point(one, None) for one in np.concatenate([np.zeros((1, dimensions)), steps])]


def normal_samples(method: str, count: int, dimensions: int, seed: int) -> Array:
    """Return samples (count, dimensions) of independent standard normal inputs.

    "lhs": Latin hypercubes of 64 samples each, every one with a seed of its own. "sobol": one
    scrambled Sobol' sequence. Both are mapped through the normal quantile.

    Args:
        method: "lhs" or "sobol".
        count: of samples, at least 1.
        dimensions: inputs.
        seed: of all draws.

    Raises:
        InputError: unknown method, or no samples.
    """
    if count < 1:
        raise InputError(f"{count} is no number of samples", "samples", "give at least 1")
    if method == "sobol":
        # random_base2 draws whole powers of two, for which the sequence is balanced
        uniform = qmc.Sobol(dimensions, seed=seed).random_base2((count - 1).bit_length())
    elif method == "lhs":
        uniform = np.concatenate(
            [
                qmc.LatinHypercube(dimensions, seed=np.random.default_rng([seed, 0, block])).random(
                    BLOCK
                )
                for block in range(-(-count // BLOCK))
            ]
        )
    else:
        raise InputError(
            f"unknown method '{method}'", "method", names_near(method, get_args(Method))
        )
    return ndtri(np.clip(uniform[:count], SMALLEST_TAIL, 1.0 - SMALLEST_TAIL))


def noise_of_point(
    point: Point, columns: Sequence[int], time: Array, correlation_time: float, seed: int
) -> Array:
    """Return the noise (f, p) of the inputs in these columns at a point.

    Args:
        point: the sample's point.
        columns: (p,) of the inputs that have noise.
        time: (f,) s, rising.
        correlation_time: s.
        seed: of all draws.
    """
    found = np.zeros((len(time), len(columns)))
    for number in dict.fromkeys(point.noise_of or ()):
        draws = noise(number, time, len(columns), correlation_time, seed)
        for place, column in enumerate(columns):
            if point.noise_of is not None and point.noise_of[column] == number:
                found[:, place] = draws[:, place]
    return found


def noise(number: int, time: Array, dimensions: int, correlation_time: float, seed: int) -> Array:
    """Return AR(1) noise (f, dimensions) of unit variance, that of one sample.

    x_0 = e_0, x_k = rho_k x_{k-1} + sqrt(1 - rho_k²) e_k, rho_k = exp(-(t_k - t_{k-1})/tau):
    stationary whatever the steps in time.

    Args:
        number: of the sample.
        time: (f,) s, rising.
        dimensions: independent series.
        correlation_time: tau, s; 0: white.
        seed: of all draws.
    """
    draws = np.random.default_rng([seed, NOISE, number]).standard_normal((len(time), dimensions))
    if correlation_time == 0.0:
        return draws
    rho = np.exp(-np.diff(time) / correlation_time)
    for k in range(1, len(time)):
        draws[k] = rho[k - 1] * draws[k - 1] + np.sqrt(1.0 - rho[k - 1] ** 2) * draws[k]
    return draws
