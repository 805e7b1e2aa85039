"""Samples of standard normal inputs, independent or correlated.

Sample n does not depend on the number of samples. A larger number therefore includes the samples of
a smaller one.

Correlated inputs ([[uncertainty.correlation]]) are z = L x, with x independent standard normal and
L L^T the correlation matrix (Cholesky). This is a Gaussian copula, because every input is a
function of one normal error. The method of Iman & Conover (1982) would make a sample depend on the
number of samples.

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
"""Round-off of an eigenvalue of the correlation matrix, or of a remaining variance."""


def correlation_root(tables: Sequence[CorrelationTable], names: Sequence[str]) -> Array:
    """Return the Cholesky factor L (d, d) of the correlation matrix of the inputs.

    Raises:
        InputError: an input does not vary, a pair occurs twice, or the coefficients contradict
            each other.
    """
    matrix = np.eye(len(names))
    for table in tables:
        row, column = (_index(name, names) for name in table.between)
        if matrix[row, column] != 0.0:
            raise InputError(f"has '{table.between[0]}' and '{table.between[1]}' twice", TABLE)
        matrix[row, column] = matrix[column, row] = table.coefficient
    least = float(np.linalg.eigvalsh(matrix)[0])
    if least < -ROUNDING:
        raise InputError(
            f"does not give a correlation matrix (smallest eigenvalue {least:.3g})",
            TABLE,
            "give smaller coefficients, or also the coefficients of other pairs",
        )
    return _cholesky(matrix)


def _index(name: str, names: Sequence[str]) -> int:
    if name in names:
        return names.index(name)
    raise InputError(
        f"'{name}' does not vary", TABLE, names_near(name, names, "the inputs that vary")
    )


def _cholesky(matrix: Array) -> Array:
    """Return the Cholesky factor of a positive semi-definite matrix.

    A column is zero if the earlier inputs determine its input.
    """
    root = np.zeros_like(matrix)
    for k in range(len(matrix)):
        remaining = matrix[k, k] - root[k, :k] @ root[k, :k]
        if remaining > ROUNDING:
            root[k, k] = np.sqrt(remaining)
            root[k + 1 :, k] = (matrix[k + 1 :, k] - root[k + 1 :, :k] @ root[k, :k]) / root[k, k]
    return root


Method = Literal["lhs", "sobol"]
BLOCK = 64
"""Number of samples in a Latin hypercube. Further samples form further hypercubes."""
SMALLEST_TAIL = 1e-9
"""Smallest probability that is mapped to a normal quantile. Sobol' points may be 0, and the
quantile of 0 is infinite."""
NOISE = 1
"""Number in the seed of the noise. The seeds of the hypercubes have 0 in its place."""


@dataclass(frozen=True, eq=False)
class Point:
    """Point of a sample in the space of the inputs.

    Args:
        normal: standard normal value of each input, shape (d,).
        noise_of: number of the sample that defines the noise of each input over the frames, length
            d; None: no noise.
    """

    normal: Array
    noise_of: tuple[int, ...] | None

    @classmethod
    def of(cls, number: int, normal: Array) -> "Point":
        """Return the point of a sample that defines the noise of all inputs."""
        return cls(normal, (number,) * len(normal))


def crossed_points(first: Array, second: Array) -> list[Point]:
    """Return the points of Saltelli's design: A, B, and A with one column from B for each input.

    The noise of an input is taken from the same matrix as its column. The points are sorted: n of
    A, n of B, then n for each input.

    Args:
        first: matrix A of standard normal values, shape (n, d).
        second: matrix B of standard normal values, shape (n, d).

    Reference: Saltelli et al., Comput Phys Commun 181:259 (2010),
    doi:10.1016/j.cpc.2009.09.018.
    """
    count, dimensions = first.shape
    points = [Point.of(n, row) for n, row in enumerate(np.concatenate([first, second]))]
    for i in range(dimensions):
        for n in range(count):
            normal, noise_of = first[n].copy(), [n] * dimensions
            normal[i], noise_of[i] = second[n, i], count + n
            points.append(Point(normal, tuple(noise_of)))
    return points


def one_at_a_time(dimensions: int) -> list[Point]:
    """Return the points of a screening: nominal, then each input at -1 and +1 deviation."""
    steps = np.repeat(np.eye(dimensions), 2, axis=0)
    steps[::2] *= -1.0
    return [Point(row, None) for row in np.concatenate([np.zeros((1, dimensions)), steps])]


def normal_samples(method: str, count: int, dimensions: int, seed: int) -> Array:
    """Return samples (count, dimensions) of independent standard normal inputs.

    "lhs" makes Latin hypercubes of `BLOCK` samples, "sobol" one scrambled Sobol' sequence. The
    normal quantile function maps these uniform samples to normal ones.

    Args:
        method: sampling method, "lhs" or "sobol".
        count: number of samples, at least 1.
        seed: seed of the random numbers.

    Raises:
        InputError: the method is unknown, or the number of samples is below 1.
    """
    if count < 1:
        raise InputError(f"{count} is not a number of samples", "samples", "give at least 1")
    if method == "sobol":
        # the Sobol' sequence is balanced for powers of two only
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
    """Return the noise (f, p) of some inputs at a point.

    Args:
        time: increasing times of the frames, s, shape (f,).
        correlation_time: correlation time of the noise, s.
        seed: seed of the random numbers.
    """
    result = np.zeros((len(time), len(columns)))
    for number in dict.fromkeys(point.noise_of or ()):
        draws = noise(number, time, len(columns), correlation_time, seed)
        for i, column in enumerate(columns):
            if point.noise_of is not None and point.noise_of[column] == number:
                result[:, i] = draws[:, i]
    return result


def noise(number: int, time: Array, dimensions: int, correlation_time: float, seed: int) -> Array:
    """Return AR(1) noise (f, dimensions) of unit variance for one sample.

    x_0 = e_0 and x_k = rho_k x_{k-1} + sqrt(1 - rho_k²) e_k with rho_k = exp(-(t_k - t_{k-1})/tau).
    The noise is stationary for any time steps.

    Args:
        time: increasing times of the frames, s, shape (f,).
        correlation_time: correlation time tau, s; 0: white noise.
        seed: seed of the random numbers.
    """
    draws = np.random.default_rng([seed, NOISE, number]).standard_normal((len(time), dimensions))
    if correlation_time == 0.0:
        return draws
    rho = np.exp(-np.diff(time) / correlation_time)
    for k in range(1, len(time)):
        draws[k] = rho[k - 1] * draws[k - 1] + np.sqrt(1.0 - rho[k - 1] ** 2) * draws[k]
    return draws
