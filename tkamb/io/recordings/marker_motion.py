"""Motion of knee and shank from skin markers, by separate rigid fits and by a chain.

Both fits are computed, and the scene chooses one:

- segments: shank and thigh are fitted separately, each with a knee centre. The distance of the
  centres shows the movement of the skin; it is a lever arm that changes the moments of the knee.
- chain: shank, knee, thigh and their neighbours are fitted at once, so that the movement of the
  skin is distributed over them.
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
from tkamb.io.recordings.filtering import Cutoff, check_spacing, differentiate_poses
from tkamb.io.recordings.inverse_kinematics import (
    FLEXION,
    ChainFit,
    LegChain,
    LegState,
    Segment,
    fit_chain,
)
from tkamb.io.recordings.laboratory import laboratory_rotation
from tkamb.io.recordings.markers import MAX_MEDIAN_RESIDUAL, fit_seen, marker_trajectories
from tkamb.io.recordings.recording_tables import MarkersTable, MotionTable, Side
from tkamb.io.recordings.tables import Table, read_table
from tkamb.io.recordings.tibia import BodyMotion
from tkamb.units import DEGREE, MILLIMETRE

Method = Literal["segments", "chain"]
KNEE_SEGMENTS = ("shank", "thigh")


# m: largest distance between two positions of one joint, each by the markers of one segment.
# Skin at the hip moves by a third of this, and the other foot is farther away.
MAX_JOINT_GAP = 0.1


@dataclass(frozen=True, eq=False)
class MarkerKinematics:
    """Kinematics of a leg from skin markers, SI. A left leg is mirrored to a right one.

    Args:
        time: (n,) s, times of the frames that `method` can fit, without a gap.
        tibia: (n, 4, 4) pose_tibia_in_laboratory by this fit.
        coordinates: (n, 6) knee coordinates by this fit.
        flexion: method -> (n,) rad; NaN in frames without a fit.
        rms: method -> (n,) m, root mean square distance of the markers of shank and thigh, or of
            all markers of the chain.
        centre_distance: (n,) m, distance between the knee centres by the separate fits of shank
            and thigh.
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
    remarks: tuple[str, ...] = ()

    def at(self, values: Array, time: Array) -> Array:
        """Return values (n,) of the frames at other times, s, by linear interpolation."""
        return np.asarray(np.interp(time, self.time, values))

    def shank_motion(self, cutoff_Hz: Cutoff, time: Array, name: str) -> BodyMotion:
        """Return the filtered motion of the shank in the laboratory at times (f,) s."""
        filtered, velocity, acceleration = differentiate_poses(
            self.time, self.tibia, cutoff_Hz, time, name
        )
        residual = self.at(self.rms[self.method], time)
        return BodyMotion(time, filtered, velocity, acceleration, residual, remarks=self.remarks)


def load_marker_motion(
    source: MotionTable, side: Side, pose_insert_in_tibia: Array
) -> MarkerKinematics:
    """Return the kinematics of knee and shank from the markers of a recording.

    Args:
        side: side of the knee; a left leg and its laboratory are mirrored.
        pose_insert_in_tibia: (4, 4) m, pose in the patient's URDF, mirrored for a left knee.
    """
    assert source.markers is not None
    recorded = read_table(source.file, source.format)
    time = recorded.time()
    check_spacing(recorded.path, time)
    segments, measured = leg_segments(source.markers, recorded, source.length_unit, side)
    neutral = neutral_coordinates(source.markers, side)
    chain = LegChain(segments, pose_insert_in_tibia, source.markers.knee == "free")
    fits, chain_fit = both_fits(chain, segments, measured, neutral, recorded)
    if not chain_fit.solved.all():
        raise InputError(
            "the chain of segments does not converge at "
            f"{time[int(np.argmin(chain_fit.solved))]:.4f} s",
            recorded.path,
            "check labels and joints in [motion.markers]; two labels may be swapped",
        )
    unmarked = np.isnan(chain_fit.rms)[:, None, None]
    readings: dict[Method, tuple[Array, Array]] = {
        "segments": (fits["shank"][0], fits["thigh"][0]),
        "chain": (
            np.where(unmarked, np.nan, chain_fit.state.shank),
            np.where(unmarked, np.nan, chain_fit.state.thigh),
        ),
    }
    rms: dict[Method, Array] = {"segments": _joint_rms(fits, measured), "chain": chain_fit.rms}
    return _compare_readings(source, recorded, time, readings, rms, chain, measured, neutral)


def both_fits(
    chain: LegChain,
    segments: list[Segment],
    measured: dict[str, Array],
    neutral: Array,
    recorded: Table,
) -> tuple[dict[str, tuple[Array, Array]], ChainFit[LegState]]:
    """Return the separate fits and the fit of the chain.

    The separate fits are segment -> (poses (n, 4, 4) m, root mean square distances (n,) m).
    """
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
    """Return the segments, and segment -> measured markers (n, m, 3) m, gaps NaN.

    They are in the laboratory's axes, those of a left leg mirrored.
    """
    scale = recorded.unit_scale(length_unit, "length_unit")
    rotation = laboratory_rotation(markers.laboratory_axes, recorded.path)
    mirror = MIRROR if side == "left" else np.eye(3)
    segments, measured = [], {}
    for table in markers.segment:
        labels = tuple(table.markers_mm)
        points = marker_trajectories(recorded, list(labels), scale) @ rotation.T
        measured[table.name] = points @ mirror
        ends = [
            None if end is None else mirror @ (np.array(end) * MILLIMETRE)
            for end in (table.joint_mm, table.centre_mm)
        ]
        segments.append(
            Segment(
                table.name,
                labels,
                np.array(list(table.markers_mm.values())) * MILLIMETRE @ mirror,
                np.array([table.weights.get(label, 1.0) for label in labels]),
                table.joined_to or "",
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
        if len(finite) and np.median(finite) > MAX_MEDIAN_RESIDUAL:
            raise InputError(
                f"markers of the {name} have a residual of {np.median(finite) / MILLIMETRE:.0f} mm",
                recorded.path,
                "check names and positions in [motion.markers], and length_unit",
            )


def _check_joints(segments: list[Segment], poses: dict[str, Array], recorded: Table) -> None:
    for segment in segments:
        name, neighbour = segment.name, segment.joined_to
        if segment.joint is None or segment.centre is None:
            continue
        ends = transform(poses[neighbour], segment.joint) - transform(poses[name], segment.centre)
        distance = np.linalg.norm(ends, axis=1)
        if np.isfinite(distance).any() and np.nanmedian(distance) > MAX_JOINT_GAP:
            raise InputError(
                f"markers of the {name} and of the {neighbour} give positions of their joint that "
                f"are {np.nanmedian(distance) / MILLIMETRE:.0f} mm apart",
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
    """Return the kinematics in the frames that the chosen method can fit.

    `readings` and `rms` have both methods: poses of shank and thigh, and residuals.
    """
    assert source.markers is not None
    method = source.markers.method
    knees = {name: _knee(shank @ chain.insert, thigh) for name, (shank, thigh) in readings.items()}
    missing = np.concatenate(
        [np.isnan(measured[name]).any(axis=2) for name in KNEE_SEGMENTS], axis=1
    )
    run = _run(time, np.isnan(knees[method][:, 0]), source.interval_s, recorded)
    return MarkerKinematics(
        time[run],
        method,
        readings[method][0][run],
        knees[method][run],
        {name: knee[run, FLEXION] for name, knee in knees.items()},
        {name: values[run] for name, values in rms.items()},
        np.linalg.norm(knees["segments"][run, :3] - neutral[:3], axis=1),
        missing.sum(axis=1)[run],
        recorded.remarks,
    )


def _joint_rms(fits: dict[str, tuple[Array, Array]], measured: dict[str, Array]) -> Array:
    """Return the root mean square distance (n,) of shank and thigh markers together."""
    counts = [np.isfinite(measured[name]).all(axis=2).sum(axis=1) for name in KNEE_SEGMENTS]
    squares = [fits[name][1] ** 2 * k for name, k in zip(KNEE_SEGMENTS, counts, strict=True)]
    return np.asarray(np.sqrt(np.sum(squares, axis=0) / np.maximum(np.sum(counts, axis=0), 1)))


def _knee(insert: Array, femur: Array) -> Array:
    """Return knee coordinates (n, 6) from poses (n, 4, 4)."""
    finite = np.isfinite(insert[:, 0, 3]) & np.isfinite(femur[:, 0, 3])
    result = np.full((len(insert), 6), np.nan)
    if finite.any():
        result[finite] = knee_coordinates(inverse(insert[finite]) @ femur[finite])
    return result


def _run(
    time: Array, missing: np.ndarray, interval: tuple[float, float] | None, recorded: Table
) -> slice:
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
