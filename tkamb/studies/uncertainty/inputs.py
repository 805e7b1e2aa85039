"""The varied inputs of a case, their standard deviations, and samples of their errors.

Sample n does not depend on the number of samples, so a larger number includes a smaller one.

Correlated inputs ([[uncertainty.correlation]]) are z = L x, with x independent standard normal and
L L^T the correlation matrix (Cholesky). This is a Gaussian copula; the method of Iman & Conover
(1982) would make a sample depend on the number of samples.

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
from tkamb.geometry.frames import KNEE_COORDINATES, Array
from tkamb.io.scene.case import Case
from tkamb.io.scene.uncertainty import SKIN_MARKER_ERROR, CorrelationTable, UncertaintyTable
from tkamb.units import DEGREE, MILLIMETRE

AXES = ("ap", "si", "ml")
COP_AXES = {"ap": 0, "ml": 2}
"""Direction -> axis of the laboratory frame."""
UNITS = {"mm": MILLIMETRE, "deg": DEGREE}
PATELLAR_LIGAMENT = "patellar_ligament"
MARKED = ("shank", "thigh")
"""Segments with varied marker positions."""
LINE_ENDS = ("origin", "insertion")
"""Ends of a muscle's line that pulls the patella."""
GROUP_ENDS = ("shank", "thigh")
"""Segments to which the lines of a muscle group are attached."""
ACROSS_KNEE = ("thigh to shank", "thigh to foot")
"""Muscle groups with lines across the knee, see `tkamb.run.muscles.leg`."""


@dataclass(frozen=True)
class VariedInput:
    """One input that varies.

    Args:
        deviation: standard deviation, in `unit`.
        unit: unit of the deviation: "mm", "deg", "relative", or "1" for a number without unit.
    """

    name: str
    deviation: float
    unit: str


def varied_inputs(case: Case) -> tuple[VariedInput, ...]:
    """Return the inputs with a standard deviation above 0, poses first.

    Poses are in the order of `KNEE_COORDINATES`.
    """
    inputs = tuple(varied for varied in _all_inputs(case) if varied.deviation > 0)
    if not inputs:
        raise InputError(
            "no input varies", "[uncertainty]", "give an input a standard deviation above 0"
        )
    return inputs


def held_inputs(case: Case) -> tuple[str, ...]:
    """Return the inputs with standard deviation 0, as "dome" for "dome.ap"."""
    constants = [constant.name for constant in _all_inputs(case) if constant.deviation == 0]
    names = (f"{name.partition('.')[0]}{'_angles' * ('.about_' in name)}" for name in constants)
    return tuple(dict.fromkeys(names))


def _all_inputs(case: Case) -> list[VariedInput]:
    table = uncertainty_of(case)
    return [
        *_pose_inputs(case, table),
        *_marker_inputs(case, table),
        *_load_inputs(case, table),
        *_muscle_inputs(case, table),
        *_tissue_inputs(case, table),
    ]


def uncertainty_of(case: Case) -> UncertaintyTable:
    """Return [uncertainty] with the default deviations."""
    table = case.scene.uncertainty or UncertaintyTable()
    return table.completed(from_markers=case.scene.motion.markers is not None)


def pose_names(inputs: tuple[VariedInput, ...]) -> list[str]:
    """Return the inputs that are knee coordinates."""
    return [varied.name for varied in inputs if varied.name in KNEE_COORDINATES]


def _pose_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    contact, markers = case.scene.contact, case.scene.motion.markers
    # the equilibrium finds the superior-inferior position together with the released coordinates
    solved = (*contact.released, "si") if contact and contact.released else ()
    stated = (case.scene.uncertainty or UncertaintyTable()).model_fields_set
    inputs = []
    for name in KNEE_COORDINATES:
        unit = "mm" if name in AXES else "deg"
        key = f"{name}_{unit}"
        # the errors of the markers already vary a coordinate that is computed from them
        with_markers = markers is not None and name in markers.coordinates and key not in stated
        if name not in solved and not with_markers:
            inputs.append(VariedInput(name, getattr(table, key), unit))
    return inputs


def _marker_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    markers = case.scene.motion.markers
    by_segment = {"shank": SKIN_MARKER_ERROR.shank_mm, "thigh": SKIN_MARKER_ERROR.thigh_mm}
    inputs: list[VariedInput] = []
    for segment in markers.segment if markers else ():
        if segment.name in MARKED:
            stated = table.markers_mm
            deviation = by_segment[segment.name] if stated is None else stated
            for label in segment.markers_mm:
                inputs += _places(f"marker.{label}", AXES, deviation)
    return inputs


def _load_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    inputs = [VariedInput("segment_mass", table.segment_mass, "relative")]
    if case.scene.ground_reaction is not None:
        inputs.append(VariedInput("ground_reaction", table.ground_reaction, "relative"))
        if case.scene.ground_reaction.applied == "cop":
            for axis in COP_AXES:
                name = f"centre_of_pressure_{axis}"
                inputs.append(VariedInput(name, getattr(table, f"{name}_mm"), "mm"))
            if case.tibia is not None:
                inputs += _places("knee_centre", AXES, table.knee_centre_mm)
                tilt = table.frontal_alignment_deg
                inputs.append(VariedInput("frontal_alignment", tilt, "deg"))
    if case.scene.contact is not None:
        inputs.append(VariedInput("friction", table.friction, "1"))
        inputs.append(VariedInput("young_modulus", table.young_modulus, "relative"))
        inputs.append(VariedInput("yield_stress", table.yield_stress, "relative"))
    return inputs


def _muscle_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    inputs: list[VariedInput] = []
    groups: tuple[str, ...] = ()
    if case.scene.muscles is not None:
        groups = ("",)
        if table.muscle_strength > 0 or table.muscle_attachment_mm > 0:
            from tkamb.run.muscles.shared_muscles import groups_of

            groups = groups_of(case)
        inputs = [
            VariedInput(f"muscle_strength.{group}", table.muscle_strength, "relative")
            for group in groups
        ]
    ends = [(muscle.name, end) for muscle in case.muscles for end in LINE_ENDS]
    ends += [(group, end) for group in groups if group in ACROSS_KNEE for end in GROUP_ENDS]
    inputs += [
        VariedInput(f"tendon_band.{name}", table.tendon_band_mm, "mm")
        for name in _wrapped_tendons(case)
    ]
    for name, end in ends:
        place = f"muscle_attachment.{name}.{end}"
        inputs += _places(place, AXES, table.muscle_attachment_mm)
    return inputs


def _wrapped_tendons(case: Case) -> list[str]:
    names = [muscle.name for muscle in case.muscles if muscle.wrap and muscle.wrap.band > 0]
    ligament = case.patellar_ligament
    if ligament is not None and ligament.wrap and ligament.wrap.band > 0:
        names.append(PATELLAR_LIGAMENT)
    return names


def _tissue_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    inputs = []
    for bundle in (*case.ligaments, *case.patella_ligaments):
        stiffness = f"ligament_stiffness.{bundle.name}"
        inputs.append(VariedInput(stiffness, table.ligament_stiffness, "relative"))
        strain = f"ligament_strain.{bundle.name}"
        inputs.append(VariedInput(strain, table.ligament_strain, "1"))
    inputs += _places("insert_placement", AXES, table.insert_placement_mm)
    inputs += [
        VariedInput(f"insert_placement.about_{axis}", table.insert_placement_deg, "deg")
        for axis in AXES
    ]
    if case.ligaments or case.muscles:
        inputs += _places("femoral_placement", AXES, table.femoral_placement_mm)
    if case.patellar_ligament is not None:
        inputs += _places("tuberosity", AXES, table.tuberosity_mm)
    patella = case.scene.patella
    if patella is not None and patella.motion == "recorded":
        inputs += _places("dome", ("ap", "si"), table.dome_mm)
    return inputs


def _places(name: str, axes: tuple[str, ...], deviation: float) -> list[VariedInput]:
    return [VariedInput(f"{name}.{axis}", deviation, "mm") for axis in axes]


@dataclass(frozen=True, eq=False)
class Draw:
    """The errors of the inputs in one sample.

    Args:
        normal: standard normal value of each input, (d,).
        noise: standard normal value of each of the p pose inputs at each frame, (f, p).
        constant_share: share of the variance of a pose error that is constant over the frames.
    """

    inputs: tuple[VariedInput, ...]
    normal: Array
    noise: Array
    constant_share: float

    def standardised(self) -> Array:
        """Return the errors at each frame, in standard deviations, (f, d)."""
        values = np.tile(self.normal, (len(self.noise), 1))
        poses = [i for i, varied in enumerate(self.inputs) if varied.name in KNEE_COORDINATES]
        share = self.constant_share
        values[:, poses] *= np.sqrt(share)
        values[:, poses] += np.sqrt(1.0 - share) * self.noise
        return values

    def error(self, name: str) -> float:
        """Return the error in SI units; 0 if it does not vary. Not for poses."""
        for varied, value in zip(self.inputs, self.normal, strict=True):
            if varied.name == name:
                return float(value) * varied.deviation * UNITS.get(varied.unit, 1.0)
        return 0.0

    def factor(self, name: str) -> float:
        """Return a log-normal factor of mean 1 with the input's relative deviation."""
        for varied, value in zip(self.inputs, self.normal, strict=True):
            if varied.name == name:
                log_variance = np.log1p(varied.deviation**2)
                return float(np.exp(np.sqrt(log_variance) * value - 0.5 * log_variance))
        return 1.0

    def place(self, name: str) -> Array:
        """Return the error of a position, m, (3,): ap, si, ml."""
        return np.array([self.error(f"{name}.{axis}") for axis in AXES])

    def turn(self, name: str) -> Array:
        """Return the error of an orientation as a rotation vector, rad, (3,): ap, si, ml."""
        return np.array([self.error(f"{name}.about_{axis}") for axis in AXES])


TABLE = "[[uncertainty.correlation]]"
ROUNDING = 1e-10
"""Round-off of an eigenvalue of the correlation matrix, or of a remaining variance."""


def correlation_root(tables: Sequence[CorrelationTable], names: Sequence[str]) -> Array:
    """Return the Cholesky factor L (d, d) of the correlation matrix of the inputs."""
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
"""Samples of a Latin hypercube; further samples form further hypercubes."""
SMALLEST_TAIL = 1e-9
"""Smallest probability that is mapped to a normal quantile: Sobol' points may be 0."""
NOISE = 1
"""Number in the noise's seed, where the hypercubes have 0."""


@dataclass(frozen=True, eq=False)
class Point:
    """Point of a sample.

    Args:
        normal: standard normal value of each input, (d,).
        noise_of: sample that defines the noise of each input over the frames, length d; None: no
            noise.
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
        first: matrix A of standard normal values, (n, d).
        second: matrix B of standard normal values, (n, d).

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
        time: increasing times of the frames, s, (f,).
        correlation_time: correlation time of the noise, s.
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
        correlation_time: correlation time tau, s; 0: white noise.
    """
    draws = np.random.default_rng([seed, NOISE, number]).standard_normal((len(time), dimensions))
    if correlation_time == 0.0:
        return draws
    rho = np.exp(-np.diff(time) / correlation_time)
    for k in range(1, len(time)):
        draws[k] = rho[k - 1] * draws[k - 1] + np.sqrt(1.0 - rho[k - 1] ** 2) * draws[k]
    return draws
