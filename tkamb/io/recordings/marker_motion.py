"""Knee and shank from skin markers: rigid fits and a chain, side by side.

The same markers are fitted in two ways. Both are computed, and one of them is used:

- segments: shank and thigh are fitted rigidly and separately. Their joint centres may differ,
  and the distance shows the movement of the skin.
- chain: shank, knee, thigh and their neighbours are fitted at once, connected by joints. The
  movement of the skin is distributed over the segments.

The knee centre by the thigh's markers and that by the shank's markers are some distance apart. This
distance is a lever arm that changes the moments of the knee.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import (
    MIRROR,
    Array,
    inverse,
    knee_coordinates,
    transform,
)
from tkamb.io.recordings.filtering import Cutoff, differentiate_poses
from tkamb.io.recordings.inverse_kinematics import (
    FLEXION,
    ChainFit,
    LegChain,
    LegState,
    Segment,
    fit_chain,
)
from tkamb.io.recordings.laboratory import laboratory_rotation
from tkamb.io.recordings.markers import MARKER_FIT, fit_seen, marker_trajectories
from tkamb.io.recordings.recording_tables import MarkersTable, MotionTable, Side
from tkamb.io.recordings.tables import Table, read_table
from tkamb.io.recordings.tibia import BodyMotion
from tkamb.units import DEGREE, MILLIMETRE

Method = Literal["segments", "chain"]
KNEE_SEGMENTS = ("shank", "thigh")


@dataclass(frozen=True)
class MarkerMotionSettings:
    """The motion of a leg from markers."""

    max_joint_gap: float = 0.1
    """m: largest distance of a joint from where the markers show it. Chosen: at the hip, skin moves
    by a third of this; the other foot is farther away."""


MARKER_MOTION = MarkerMotionSettings()


@dataclass(frozen=True, eq=False)
class MarkerKinematics:
    """Kinematics of a leg from skin markers, as a right leg, SI.

    Args:
        time: (n,) s, the frames that `method` can fit, without a gap.
        method: the fit that is used.
        tibia: (n, 4, 4) pose_tibia_in_laboratory by this fit.
        coordinates: (n, 6) knee coordinates by this fit.
        flexion: method -> (n,) rad; NaN where the segments could not be fitted.
        rms: method -> (n,) m, root mean square distance of the markers of shank and thigh, or of
            all markers of the chain.
        centre_distance: (n,) m, distance between the knee centres by the shank's and by the
            thigh's markers, with separate fits.
        missing: (n,) number of missing markers of shank and thigh.
    """

    time: Array
    method: Method
    tibia: Array
    coordinates: Array
    flexion: dict[Method, Array]
    rms: dict[Method, Array]
    centre_distance: Array
    missing: np.ndarray

    def at(self, values: Array, time: Array) -> Array:
        """Return values (n,) of the frames at other times, s, by linear interpolation."""
        return np.asarray(np.interp(time, self.time, values))

    def shank_motion(self, cutoff_Hz: Cutoff, time: Array, name: str) -> BodyMotion:
        """Return the shank in the laboratory, filtered, at the frames' times."""
        filtered, velocity, acceleration = differentiate_poses(
            self.time, self.tibia, cutoff_Hz, time, name
        )
        residual = self.at(self.rms[self.method], time)
        return BodyMotion(time, filtered, velocity, acceleration, residual)


def load_marker_motion(
    source: MotionTable, side: Side, pose_insert_in_tibia: Array
) -> MarkerKinematics:
    """Return knee and shank of a recording's markers.

    Args:
        source: the scene's [motion], with markers.
        side: side of the knee; a left leg and its laboratory are mirrored.
        pose_insert_in_tibia: (4, 4) m, of the patient, mirrored for a left knee.

    Raises:
        InputError: file, labels or markers cannot be used, the fit is poor or does not converge,
            or a gap in the interval.
    """
    assert source.markers is not None
    recorded = read_table(source.file, source.format)
    time = recorded.time()
    segments, measured = leg_segments(source.markers, recorded, source.length_unit, side)
    neutral = neutral_coordinates(source.markers, side)
    chain = LegChain(segments, pose_insert_in_tibia, source.markers.knee == "free")
    fits, whole = both_fits(chain, segments, measured, neutral, recorded)
    if not whole.solved.all():
        raise InputError(
            f"the chain of segments does not converge at {time[int(np.argmin(whole.solved))]:.4f} "
            f"s",
            recorded.path,
            "check labels and joints in [motion.markers]; two labels may be swapped",
        )
    blind = np.isnan(whole.rms)[:, None, None]
    readings: dict[Method, tuple[Array, Array]] = {
        "segments": (fits["shank"][0], fits["thigh"][0]),
        "chain": (
            np.where(blind, np.nan, whole.state.shank),
            np.where(blind, np.nan, whole.state.thigh),
        ),
    }
    rms: dict[Method, Array] = {"segments": _joint_rms(fits, measured), "chain": whole.rms}
    return _compare_readings(source, recorded, time, readings, rms, chain, measured, neutral)


def both_fits(
    chain: LegChain,
    segments: list[Segment],
    measured: dict[str, Array],
    neutral: Array,
    recorded: Table,
) -> tuple[dict[str, tuple[Array, Array]], ChainFit[LegState]]:
    """Return segment -> separate fit (poses (n, 4, 4) m, rms (n,) m), and the fit of the chain."""
    fits = {s.name: fit_seen(measured[s.name], s.points, s.weights, s.name) for s in segments}
    _check_fits({name: fit[1] for name, fit in fits.items()}, recorded)
    _check_joints(segments, {name: fit[0] for name, fit in fits.items()}, recorded)
    points = np.concatenate([measured[s.name] for s in segments], axis=1)
    weights = np.concatenate([s.weights for s in segments])
    start = chain.start({name: fit[0] for name, fit in fits.items()}, neutral)
    return fits, fit_chain(chain, points, weights, start)


def leg_segments(
    markers: MarkersTable, recorded: Table, length_unit: str | None, side: str
) -> tuple[list[Segment], dict[str, Array]]:
    """Return the segments, and segment -> its markers (n, m, 3) m, laboratory, gaps NaN.

    Raises:
        InputError: the recording lacks a marker.
    """
    scale = recorded.unit_scale(length_unit, "length_unit")
    rotation = laboratory_rotation(markers.laboratory_axes, recorded.path)
    mirror = MIRROR if side == "left" else np.eye(3)
    segments, measured = [], {}
    for own in markers.segment:
        labels = tuple(own.markers_mm)
        points = marker_trajectories(recorded, list(labels), scale) @ rotation.T
        measured[own.name] = points @ mirror
        ends = [
            None if end is None else mirror @ (np.array(end) * MILLIMETRE)
            for end in (own.joint_mm, own.centre_mm)
        ]
        segments.append(
            Segment(
                own.name,
                labels,
                np.array(list(own.markers_mm.values())) * MILLIMETRE @ mirror,
                np.array([own.weights.get(label, 1.0) for label in labels]),
                own.joined_to or "",
                *ends,
            )
        )
    return segments, measured


def neutral_coordinates(markers: MarkersTable, side: str) -> Array:
    """Return the constant knee coordinates (6,), m and rad, of a hinge, with zero flexion."""
    ap, si, ml = np.array(markers.neutral_mm) * MILLIMETRE
    axial, adduction = np.array(markers.neutral_deg) * DEGREE
    return np.array([ap, si, -ml if side == "left" else ml, axial, adduction, 0.0])


def _check_fits(rms: dict[str, Array], recorded: Table) -> None:
    for name, values in rms.items():
        finite = values[np.isfinite(values)]
        if not len(finite) and name in ("shank", "thigh"):
            raise InputError(
                f"fewer than three markers of the {name} are seen together",
                recorded.path,
                "check the labels in [motion.markers], or use another trial",
            )
        if len(finite) and np.median(finite) > MARKER_FIT.max_median_residual:
            raise InputError(
                f"markers of the {name} fit only to {np.median(finite) / MILLIMETRE:.0f} mm",
                recorded.path,
                "check names and positions in [motion.markers], and length_unit",
            )


def _check_joints(segments: list[Segment], poses: dict[str, Array], recorded: Table) -> None:
    """Raise where the joint by a segment's markers is far from that by its neighbour's."""
    for own in segments:
        if own.joint is None or own.centre is None:
            continue
        ends = transform(poses[own.joined_to], own.joint) - transform(poses[own.name], own.centre)
        apart = np.linalg.norm(ends, axis=1)
        if np.isfinite(apart).any() and np.nanmedian(apart) > MARKER_MOTION.max_joint_gap:
            raise InputError(
                f"markers of the {own.name} put its joint with the {own.joined_to} "
                f"{np.nanmedian(apart) / MILLIMETRE:.0f} mm from where the {own.joined_to}'s do",
                recorded.path,
                "check the labels in [motion.markers]; left and right may be swapped",
            )


def _compare_readings(
    source: MotionTable,
    recorded: Table,
    time: Array,
    readings: dict[Method, tuple[Array, Array]],
    rms: dict[Method, Array],
    chain: LegChain,
    measured: dict[str, Array],
    neutral: Array,
) -> MarkerKinematics:
    """Return the result from both fits, (shank, thigh), in the frames of the method in use."""
    assert source.markers is not None
    used = source.markers.method
    knees = {name: _knee(low @ chain.insert, high) for name, (low, high) in readings.items()}
    missing = np.concatenate(
        [np.isnan(measured[name]).any(axis=2) for name in KNEE_SEGMENTS], axis=1
    )
    run = _run(time, np.isnan(knees[used][:, 0]), source.interval_s, recorded)
    return MarkerKinematics(
        time[run],
        used,
        readings[used][0][run],
        knees[used][run],
        {name: knee[run, FLEXION] for name, knee in knees.items()},
        {name: values[run] for name, values in rms.items()},
        np.linalg.norm(knees["segments"][run, :3] - neutral[:3], axis=1),
        missing.sum(axis=1)[run],
    )


def _joint_rms(fits: dict[str, tuple[Array, Array]], measured: dict[str, Array]) -> Array:
    """Return the root mean square distance (n,) of shank and thigh markers together."""
    counts = [np.isfinite(measured[name]).all(axis=2).sum(axis=1) for name in KNEE_SEGMENTS]
    squares = [fits[name][1] ** 2 * k for name, k in zip(KNEE_SEGMENTS, counts, strict=True)]
    return np.asarray(np.sqrt(np.sum(squares, axis=0) / np.maximum(np.sum(counts, axis=0), 1)))


def _knee(insert: Array, femur: Array) -> Array:
    """Return knee coordinates (n, 6) from poses (n, 4, 4); NaN where a pose is NaN."""
    finite = np.isfinite(insert[:, 0, 3]) & np.isfinite(femur[:, 0, 3])
    result = np.full((len(insert), 6), np.nan)
    if finite.any():
        result[finite] = knee_coordinates(inverse(insert[finite]) @ femur[finite])
    return result


def _run(
    time: Array, missing: np.ndarray, interval: tuple[float, float] | None, recorded: Table
) -> slice:
    """Return the longest run of frames around the interval without a missing frame.

    Without an interval it must be the whole recording.
    """
    start, end = interval or (time[0], time[-1])
    if start < time[0] - 1e-9 or end > time[-1] + 1e-9:
        raise InputError(
            f"covers {time[0]:.4f} to {time[-1]:.4f} s, but {start:.4f} to {end:.4f} s is needed",
            recorded.path,
            "choose [motion] interval_s inside the recording",
        )
    inside = (time >= start - 1e-9) & (time <= end + 1e-9)
    if (inside & missing).any():
        k = int(np.argmax(inside & missing))
        raise InputError(
            f"too few markers of shank and thigh are seen at {time[k]:.4f} s",
            recorded.path,
            "choose [motion] interval_s between the gaps, or method = 'chain'",
        )
    first, last = int(np.argmax(inside)), len(time) - int(np.argmax(inside[::-1]))
    before, after = np.flatnonzero(missing[:first]), np.flatnonzero(missing[last:])
    return slice(
        int(before[-1]) + 1 if len(before) else 0, last + int(after[0]) if len(after) else None
    )
