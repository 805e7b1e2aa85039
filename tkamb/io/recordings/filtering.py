"""Low-pass filter and differentiation of recorded motion on any time grid, and odd samples.

The filter is the quintic smoothing spline: the function s that minimises

    sum_i w_i (x_i - s(t_i))^2 + lambda * integral (s''')^2 dt,     lambda = (2 pi f_c)^-6

with w_i the spacing of the samples. Away from the ends its frequency response is
1 / (1 + (f / f_c)^6), that of a third-order Butterworth filter run forwards and backwards: one half
at the cut-off f_c, no phase shift. Unlike that filter, it accepts uneven samples, and its first and
second derivatives belong to one smooth curve. Polynomials of degree two pass unchanged.

The ends are natural; samples are not padded. Example: a 1 Hz wave with a cut-off of 6 Hz. The root
mean square error of its acceleration, as a share of the amplitude, is 0.23 at an end. At a distance
of a quarter, a half and one period of the cut-off it is 0.06, 0.013 and 0.002. A two-pass
Butterworth filter with reflected ends has errors of 0.64, 0.16, 0.11 and 0.02 at these places.

`periodic=True` closes the curve: the last sample is the first one of the next cycle, and there are
no ends.

`cutoff_Hz = "none"` interpolates the samples with a quintic spline.

References:
    Woltring, Adv Eng Softw 8:104 (1986), doi:10.1016/0141-1195(86)90098-7;
    Craven & Wahba, Numer Math 31:377 (1979), doi:10.1007/BF01404567.

The deviation of a sample is its distance from the cubic through its two neighbours on either side.
A sample is odd if its deviation exceeds `floor` and many times the median deviation around it.
Noise is therefore not odd: it raises the median, which a single odd sample hardly changes.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, pose

if TYPE_CHECKING:
    from scipy.interpolate import BSpline


Cutoff = float | Literal["none"]


# Degree of the splines. Accelerations are then cubic and continuous.
DEGREE = 5
# Largest number of knots per period of the cut-off frequency. The splines then
# follow all frequencies that the filter passes.
KNOTS_PER_PERIOD = 16
# Shortest motion, in periods of the cut-off frequency. In a shorter motion all
# samples are near an end.
MIN_PERIODS = 1.0


def differentiate_coordinates(
    time: Array,
    coordinates: Array,
    cutoff_Hz: Cutoff,
    at: Array | None = None,
    periodic: bool = False,
    name: str = "motion",
) -> tuple[Array, Array, Array]:
    """Low-pass filter coordinates and differentiate them twice.

    Args:
        time: (n,) s, strictly rising.
        coordinates: (n, k) or (n,), any unit; angles unwrapped.
        cutoff_Hz: frequency at which the amplitude is halved, or "none".
        at: (f,) s, times of the result, within `time`; default: `time`.
        periodic: whether the samples are one closed cycle, from time[0] to time[-1].

    Returns:
        Value, first and second derivative, each (f, k) or (f,).
    """
    time, values = np.asarray(time, float), np.asarray(coordinates, float)
    at = time if at is None else np.asarray(at, float)
    _check_samples(time, values, at, name)
    if cutoff_Hz == "none":
        curve = _interpolating_spline(time, values, periodic)
    else:
        _check_cutoff(time, cutoff_Hz, name)
        curve = _smoothing_spline(time, values, float(cutoff_Hz), periodic)
    return curve(at), curve(at, 1), curve(at, 2)


def differentiate_poses(
    time: Array,
    poses: Array,
    cutoff_Hz: Cutoff,
    at: Array | None = None,
    name: str = "motion",
) -> tuple[Array, Array, Array]:
    """Low-pass filter poses of a body and differentiate them twice.

    Positions are filtered as coordinates, and orientations as sign-continuous quaternions that are
    normalised afterwards. The result does not depend on the axes of either frame, only the
    positions depend on the body's origin. With s the filtered quaternion,

        omega = 2 vec(s* s') / |s|^2,   alpha = 2 vec(s* s'') / |s|^2 - 2 omega (s . s') / |s|^2

    Args:
        poses: (n, 4, 4) pose_body_in_world, m. The other arguments are those of
            `differentiate_coordinates`.

    Returns:
        Poses (f, 4, 4), spatial velocity (f, 6) and spatial acceleration (f, 6). Both are linear,
        then angular, in the body's axes at the body's origin: v = (R^T p', omega), a = dv/dt
        component by component. This is Pinocchio's convention for a free flyer.
    """
    poses = np.asarray(poses, float)
    if not np.isfinite(poses).all():
        raise InputError("a pose is not finite", name)
    p, dp, ddp = differentiate_coordinates(time, poses[:, :3, 3], cutoff_Hz, at, name=name)
    quaternions = _continuous(Rotation.from_matrix(poses[:, :3, :3]).as_quat())
    s, ds, dds = differentiate_coordinates(time, quaternions, cutoff_Hz, at, name=name)
    square = np.sum(s * s, axis=1, keepdims=True)
    omega = 2.0 * _relative_vector(s, ds) / square
    alpha = 2.0 * _relative_vector(s, dds) / square
    alpha -= 2.0 * omega * np.sum(s * ds, axis=1, keepdims=True) / square
    rotation = Rotation.from_quat(s).as_matrix()
    linear = np.einsum("fji,fj->fi", rotation, dp)
    linear_rate = np.einsum("fji,fj->fi", rotation, ddp) - np.cross(omega, linear)
    velocity = np.concatenate([linear, omega], axis=1)
    return pose(rotation, p), velocity, np.concatenate([linear_rate, alpha], axis=1)


def _continuous(quaternions: Array) -> Array:
    """Return the quaternions (n, 4) with signs that make consecutive rows continuous."""
    turns = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    signs = np.cumprod(np.where(np.concatenate([[False], turns]), -1.0, 1.0))
    return np.asarray(quaternions * signs[:, None])


def _relative_vector(s: Array, r: Array) -> Array:
    """Return the vector part of conj(s) r for quaternions (f, 4), scalar last."""
    sv, sw, rv, rw = s[:, :3], s[:, 3:], r[:, :3], r[:, 3:]
    return np.asarray(sw * rv - rw * sv - np.cross(sv, rv))


def _check_samples(time: Array, values: Array, at: Array, name: str) -> None:
    if not (np.isfinite(time).all() and np.isfinite(values).all()):
        raise InputError("a time or value is missing or not finite", name, "fill or cut the gap")
    if np.any(np.diff(time) <= 0):
        raise InputError("times do not rise strictly", name, "sort them and drop duplicates")
    if len(time) < DEGREE + 1:
        raise InputError(
            f"{len(time)} samples are too few to differentiate twice",
            name,
            f"record at least {DEGREE + 1}",
        )
    slack = 1e-9 * (time[-1] - time[0])
    outside = at[(at < time[0] - slack) | (at > time[-1] + slack)]
    if len(outside):
        raise InputError(
            f"covers {time[0]:g} to {time[-1]:g} s, but {outside[0]:g} s is needed",
            name,
            "choose an interval inside the recording",
        )


def check_frames(time: Array, cutoff_Hz: Cutoff, frames: int | None) -> None:
    """Raise an InputError if the resampled times (f,) s are too far apart for the cut-off.

    A recording is filtered at its own samples before it is resampled. Results at the frames (a
    solved patella, a rolling femur) are filtered at the frames' rate.

    Args:
        frames: [motion] frames; None: not resampled.
    """
    if frames is None or cutoff_Hz == "none":
        return
    rate = (len(time) - 1) / float(time[-1] - time[0])
    if cutoff_Hz >= 0.5 * rate:
        least = math.floor(2.0 * cutoff_Hz * float(time[-1] - time[0])) + 2
        raise InputError(
            f"frames = {frames} resamples to {rate:.3g} Hz, and results at the frames are low-pass "
            f"filtered at {cutoff_Hz:g} Hz, which needs more than twice as many frames per second",
            "[motion] frames",
            f"give {least} or more, or leave frames out; frames=slice(A, B, STEP) computes fewer",
        )


def _check_cutoff(time: Array, cutoff_Hz: float, name: str) -> None:
    duration, half_rate = time[-1] - time[0], 0.5 / np.diff(time).max()
    if not (math.isfinite(cutoff_Hz) and cutoff_Hz > 0):
        raise InputError(
            f"cut-off {cutoff_Hz:g} Hz is not a positive number",
            name,
            'set cutoff_Hz of the scene to a positive number, or "none" to trust the samples',
        )
    if cutoff_Hz >= half_rate:
        raise InputError(
            f"cut-off {cutoff_Hz:g} Hz is not below {half_rate:g} Hz, half the sampling rate "
            "at the widest step",
            name,
            'lower cutoff_Hz of the scene, or set it to "none" to trust the samples',
        )
    if duration * cutoff_Hz < MIN_PERIODS:
        raise InputError(
            f"{duration:g} s are shorter than one period of the cut-off {cutoff_Hz:g} Hz",
            name,
            'record longer, raise cutoff_Hz of the scene, or set it to "none" to trust the samples',
        )


def _interpolating_spline(time: Array, values: Array, periodic: bool) -> "BSpline":
    # Imported here, because the import is slow and an error in a table should be reported at once.
    from scipy.interpolate import make_interp_spline

    if periodic:
        values = values.copy()
        values[0] = values[-1] = 0.5 * (values[0] + values[-1])
        return make_interp_spline(time, values, DEGREE, bc_type="periodic")
    return make_interp_spline(time, values, DEGREE)


def _smoothing_spline(time: Array, values: Array, cutoff_Hz: float, periodic: bool) -> "BSpline":
    """Return the spline of the module's equation."""
    from scipy.interpolate import BSpline
    from scipy.sparse.linalg import splu

    unit = 1.0 / (2.0 * math.pi * cutoff_Hz)  # in this unit of time lambda is one
    start, end = time[0] / unit, time[-1] / unit
    pieces = math.ceil((end - start) * KNOTS_PER_PERIOD / math.tau)
    spans = max(DEGREE + 1, min(2 * len(time), pieces))
    step = (end - start) / spans
    knots = start + step * np.arange(-DEGREE, spans + DEGREE + 1)
    inside = np.clip(
        time / unit, knots[DEGREE], knots[-DEGREE - 1]
    )  # rounding may put an end outside
    design = BSpline.design_matrix(inside, knots, DEGREE)
    weights = np.gradient(time / unit)
    if periodic:
        weights[[0, -1]] *= 0.5  # both are the sample at phase zero
    wrap = sp.eye_array(spans + DEGREE, format="csr")
    if periodic:
        wrap = sp.vstack([wrap[:spans, :spans], wrap[:DEGREE, :spans]], format="csr")
    penalty = wrap.T @ _third_derivative_gram(spans, step) @ wrap
    design = design @ wrap
    normal = design.T @ sp.diags_array(weights) @ design + penalty
    right = design.T @ (weights[:, None] * values.reshape(len(values), -1))
    coefficients = wrap @ splu(normal.tocsc()).solve(right)
    return BSpline(knots * unit, coefficients.reshape(-1, *values.shape[1:]), DEGREE)


def _third_derivative_gram(spans: int, step: float) -> sp.csr_array:
    """Return the integrals of B_i''' B_j''' over all spans of uniform knots.

    B_i''' is of degree two: its coefficients are the third differences of the original ones,
    divided by step^3, and three Gauss points per span integrate the products exactly.
    """
    from scipy.interpolate import BSpline

    knots = np.arange(-2.0, spans + 3.0)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    points = (np.arange(spans)[:, None] + 0.5 + 0.5 * nodes).ravel()
    quadratic = BSpline.design_matrix(points, knots, 2)
    size = spans + DEGREE
    third = sp.diags_array(
        [-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(size - 3, size), format="csr"
    )
    basis = quadratic @ third / step**3
    return sp.csr_array(basis.T @ sp.diags_array(np.tile(0.5 * step * weights, spans)) @ basis)


# Number of samples on either side for the median deviation. Not studied.
NEIGHBOURS = 12
# 1: smallest ratio of an odd sample's deviation to the median. Normal noise exceeds
# it once in 10 million samples.
OUTLIER_FACTOR = 8.0
# s: largest median step between samples. Slower samples record no movement.
MAX_STEP = 5.0
# 1: factor on `OUTLIER_FACTOR` at the ends of a recording. Extrapolation of a cubic
# has larger errors than interpolation.
END_FACTOR = 4.0


@dataclass(frozen=True)
class OddSample:
    """A sample off its neighbours' curve.

    Args:
        time: s.
        away: distance from the curve, in `unit`.
        unit: unit of `away`, like "mm".
    """

    path: Path
    what: str
    time: float
    away: float
    unit: str


def odd_samples(
    path: Path, what: str, time: Array, values: Array, floor: float, scale: float, unit: str
) -> tuple[OddSample, ...]:
    """Return the odd samples of one quantity.

    Args:
        time: (n,) s, rising.
        values: (n,) SI.
        floor: smallest deviation of an odd sample, SI.
        scale: SI per `unit`.
    """
    if len(time) < 6:
        return ()
    away = np.abs(values - neighbours_curve(time, values))
    ends = np.ones(len(time))
    ends[[0, 1, -2, -1]] = END_FACTOR
    limit = np.maximum(floor, OUTLIER_FACTOR * _running_median(away / ends)) * ends
    # An odd sample also shifts the curves of its four neighbours, by 2/3 and 1/6 of its deviation.
    odd = [k for k in np.flatnonzero(away > limit) if away[k] >= away[max(k - 2, 0) : k + 3].max()]
    return tuple(OddSample(path, what, float(time[k]), float(away[k] / scale), unit) for k in odd)


def neighbours_curve(time: Array, values: Array) -> Array:
    """Return the cubic (n,) through each sample's four neighbours, two on either side."""
    n = len(time)
    first = np.clip(np.arange(n) - 2, 0, n - 5)
    others = first[:, None] + np.arange(5)
    others = others[others != np.arange(n)[:, None]].reshape(n, 4)
    t, sample_time = time[others], time[:, None]
    weights = np.ones((n, 4))
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[:, i] *= (sample_time[:, 0] - t[:, j]) / (t[:, i] - t[:, j])
    return np.asarray((weights * values[others]).sum(axis=1))


def _running_median(away: Array) -> Array:
    width = min(2 * NEIGHBOURS + 1, len(away))
    windows = np.lib.stride_tricks.sliding_window_view(away, width)
    start = np.clip(np.arange(len(away)) - width // 2, 0, len(windows) - 1)
    return np.asarray(np.median(windows, axis=1)[start])


def check_spacing(path: Path, time: Array) -> None:
    """Raise an InputError if times (n,) s are no movement: one, or too far apart."""
    if len(time) == 1:
        what = f"has one row, at {time[0]:g} s, which is no movement"
        raise InputError(what, path, "give a recording of several rows")
    spacing = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if spacing > MAX_STEP:
        raise InputError(
            f"samples are {spacing:g} s apart, too far to be a movement",
            path,
            "the time must be in seconds: rewrite the column if it is in another unit",
        )


def check_overlap(path: Path, clock: Array, time: Array, table: str) -> None:
    """Raise an InputError if a measurement and the motion have no common time.

    Args:
        clock: (n,) s, times of the file's samples on the motion's clock.
        time: (f,) s, times of the motion.
        table: the scene's table that names the file, like "[measured]".
    """
    if clock[-1] < time[0] or clock[0] > time[-1]:
        raise InputError(
            f"was measured from {clock[0]:g} to {clock[-1]:g} s, but the motion lasts from "
            f"{time[0]:g} to {time[-1]:g} s",
            path,
            f"correct {table} offset_s, or use another file",
        )


def check_steps(
    path: Path, what: str, time: Array, values: Array, fastest: float, scale: float, unit: str
) -> None:
    """Raise an InputError if a quantity (n,) changes faster than `fastest` (SI per second)."""
    if len(time) < 2:
        return
    rate = np.abs(np.diff(values)) / np.diff(time)
    k = int(np.argmax(rate))
    if rate[k] > fastest:
        raise InputError(
            f"{what} steps from {values[k] / scale:.4g} to {values[k + 1] / scale:.4g} {unit} "
            f"between {time[k]:g} and {time[k + 1]:g} s, which is impossible",
            path,
            "check whether a cell is mistyped, and whether the time is in seconds",
        )


def check_range(
    path: Path, what: str, values: Array, limits: tuple[float, float], unit: str, hint: str
) -> None:
    """Raise an InputError with a hint if values (n,) leave `limits`, both in `unit`.

    `what` is like "knee: flexion".
    """
    low, high = limits
    outside: NDArray[np.bool_] = ~((values >= low) & (values <= high))
    if outside.any():
        body, _, quantity = what.partition(": ")
        raise InputError(
            f"{quantity} runs from {values.min():.4g} to {values.max():.4g} {unit}, which no "
            f"{body} does ({low:g} to {high:g}; first in data row {int(np.argmax(outside)) + 1})",
            path,
            hint,
        )
