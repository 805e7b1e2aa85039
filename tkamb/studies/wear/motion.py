"""The motion of one cycle: poses of the femoral component, and the load at each pose."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple, get_args

import numpy as np
import pinocchio
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import Array, inverse, knee_coordinates, knee_pose
from tkamb.io.recordings.recording_tables import DEFAULT_CLOSING, Closing
from tkamb.studies.wear.simulator import ForceDrive
from tkamb.units import MILLIMETRE

CLOSINGS: tuple[Closing, ...] = get_args(Closing)


@dataclass(frozen=True)
class CycleMotionSettings:
    """Closing of a recorded motion to a cycle."""

    lever_arm: float = 0.025
    """m: displacement per rotation in rad, to add rotations to translations. Half the
    distance between the condyles."""
    notable_gap: float = 0.1
    """Distance between the ends of the motion, relative to its extent, above which the report adds
    a question. The ends of recorded cycles are closer."""


CYCLE_MOTION = CycleMotionSettings()


class Path(NamedTuple):
    """Path of the femoral component, with more poses than the computed frames.

    Args:
        poses: pose_femoral_in_insert, shape (g, 4, 4). Their y is not used; the load gives it.
        place: position of each pose among the frames, shape (g,). 2.5 is midway between frames 2
            and 3.
    """

    poses: Array
    place: Array

    def weights(self, rows: Sequence[int]) -> Array:
        """Return weights (g, n) that interpolate values at the n frames `rows` to the path."""
        place = np.interp(self.place, rows, np.arange(len(rows)))
        return np.array(
            [np.interp(place, np.arange(len(rows)), unit) for unit in np.eye(len(rows))]
        ).T


@dataclass(frozen=True, eq=False)
class CycleMotion:
    """One cycle.

    Args:
        poses: pose_femoral_in_insert, shape (f, 4, 4). The press keeps rotation, x and z.
        load: load along -y, N, shape (f,).
        duration: duration of a cycle, s.
        passes: passes through the frames per cycle: 2 for a motion there and back, else 1.
        drive: loads from which equilibrium on each insert gives the poses. `poses` are then initial
            guesses. None: the poses are prescribed.
        seconds: duration of each step in one pass, s, shape (f - 1,); None: equal steps.
        path: poses at and between the frames; None: a screw motion from frame to frame.
        closing: closing of the recorded frames to a cycle; "" for a simulator's profile.
    """

    poses: Array
    load: Array
    duration: float
    passes: int = 1
    notes: tuple[str, ...] = ()
    drive: ForceDrive | None = None
    seconds: Array | None = None
    path: "Path | None" = None
    closing: str = ""
    questions: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.load)

    @classmethod
    def of_frames(
        cls,
        time: Array,
        poses: Array,
        load: Array,
        closing: Closing = DEFAULT_CLOSING,
        interval: float | None = None,
        track: tuple[Array, Array] | None = None,
    ) -> "CycleMotion":
        """Return the cycle of recorded frames.

        `closing` gives the way from the last frame to the first, for any number of frames and any
        distance between the ends:

        - "interpolate": one screw motion, with a linear load. It is divided into steps that are
          at most as long as the longest step between frames.
        - "there-and-back": the frames in reverse order.
        - "as recorded": none. The motion starts again at the first frame.

        Args:
            time: times of the frames, s, shape (f,).
            poses: pose_femoral_in_insert, shape (f, 4, 4); NaN for a failed frame.
            load: load along -y, N, shape (f,); NaN for a failed frame.
            interval: duration of the screw motion, s; None: the mean interval between the frames.
            track: times, s, shape (g,), and poses, shape (g, 4, 4), of the whole recording;
                None: only the poses of the frames are known.
        """
        check_closing(closing)
        finite = np.isfinite(load) & np.isfinite(poses).all(axis=(1, 2))
        notes, questions = [], []
        if missing := int((~finite).sum()):
            notes.append(f"{missing} of {len(finite)} frames failed; the cycle omits them")
        time, poses, load = time[finite], poses[finite], load[finite]
        if len(time) < 2:
            raise InputError("fewer than two frames have a contact", "wear", "see the run's status")
        steps, span = np.diff(time), float(time[-1] - time[0])
        path = None if track is None else _path(time, track)
        if closing == "there-and-back":
            notes.append("a cycle is the motion there and back")
            return cls(
                poses,
                load,
                2.0 * span,
                2,
                tuple(notes),
                seconds=steps,
                path=path,
                closing=closing,
            )
        gap = distance(poses[-1], poses[0])
        extent = max(distance(poses[0], pose) for pose in poses)
        apart = f"the motion's ends are {gap / MILLIMETRE:.3g} mm apart"
        if closing == "as recorded":
            notes.append(f"a cycle is the frames as recorded; {apart}, and the gap is not closed")
            return cls(
                poses, load, span, 1, tuple(notes), seconds=steps, path=path, closing=closing
            )
        if gap > CYCLE_MOTION.notable_gap * extent:
            questions.append(
                f"{apart}, {gap / extent:.0%} of its extent, and the cycle closes with one screw "
                "motion from the last frame to the first; check that this is intended (otherwise "
                "--close there-and-back, or 'as recorded')"
            )
        longest = max(distance(a, b) for a, b in pairwise(poses))
        pieces = 1 if longest == 0 else max(1, int(np.ceil(gap / longest - 1e-9)))
        way = _way(poses[-1], poses[0], pieces)
        loads = np.linspace(load[-1], load[0], pieces + 1)
        interval = span / (len(time) - 1) if interval is None else interval
        if path is not None:
            places = len(time) - 1 + np.arange(1, pieces + 1)
            path = Path(np.concatenate([path.poses, way[1:]]), np.append(path.place, places))
        notes.append(
            f"a closed cycle: {apart}, closed by a screw motion"
            + (f" in {pieces} steps" if pieces > 1 else "")
        )
        return cls(
            np.concatenate([poses, way[1:]]),
            np.concatenate([load, loads[1:]]),
            span + interval,
            1,
            tuple(notes),
            seconds=np.append(steps, np.full(pieces, interval / pieces)),
            path=path,
            closing=closing,
            questions=tuple(questions),
        )

    def refined(self) -> "CycleMotion":
        """Return the motion with an additional frame in the middle of each step.

        Knee coordinates, load and applied forces are interpolated linearly, like a profile.
        """
        poses = knee_pose(_with_middles(knee_coordinates(self.poses)))
        drive = self.drive
        if drive is not None:
            drive = replace(
                drive,
                coordinates=_with_middles(drive.coordinates),
                applied=_with_middles(drive.applied),
                percent=None
                if drive.percent is None
                else _with_middles(drive.percent[:, None])[:, 0],
            )
        seconds = np.repeat(0.5 * self.step_seconds, 2)
        load = _with_middles(self.load[:, None])[:, 0]
        return replace(self, poses=poses, load=load, drive=drive, seconds=seconds)

    @property
    def every_second(self) -> list[int]:
        """Indices of every second frame, and of the last frame."""
        chosen = list(range(0, len(self), 2))
        return chosen if chosen[-1] == len(self) - 1 else [*chosen, len(self) - 1]

    @property
    def step_seconds(self) -> Array:
        """Duration of each step in one pass, s, shape (f - 1,)."""
        if self.seconds is not None:
            return self.seconds
        steps = len(self) - 1
        return np.full(steps, self.duration / self.passes / steps)

    def seconds_between(self, rows: list[int]) -> Array:
        """Return the durations from each of the n frames `rows` to the next, s, shape (n - 1,).

        A frame with a smaller number than its predecessor belongs to the next cycle.
        """
        times = np.concatenate([[0.0], np.cumsum(self.step_seconds)])
        between = np.diff(times[rows])
        return np.where(between < 0, between + times[-1], between)


def check_closing(closing: str) -> None:
    """Raise an InputError if the closing of a cycle is unknown."""
    if closing not in CLOSINGS:
        raise InputError(
            f"no way '{closing}' to close a cycle", "--close", names_near(closing, CLOSINGS)
        )


def chosen_frames(count: int, most: int) -> list[range]:
    """Return at most `most` of `count` frames, including the first and the last.

    The frames are as evenly spaced as possible: up to two successive ranges with strides that
    differ by one.
    """
    if count <= most:
        return [range(count)]
    steps = most - 1
    short, longer = divmod(count - 1, steps)
    turn = (steps - longer) * short
    return (
        [range(0, turn, short), range(turn, count, short + 1)]
        if longer
        else [range(0, count, short)]
    )


def _path(time: Array, track: tuple[Array, Array]) -> Path | None:
    recorded, poses = track
    inside = (recorded >= time[0]) & (recorded <= time[-1])
    if not np.isfinite(poses[inside]).all():
        return None
    return Path(poses[inside], np.interp(recorded[inside], time, np.arange(len(time))))


def _way(begin: Array, end: Array, pieces: int) -> Array:
    twist = pinocchio.log6(pinocchio.SE3(end @ inverse(begin)))
    shares = np.linspace(0.0, 1.0, pieces + 1)
    way = np.array([pinocchio.exp6(pinocchio.Motion(s * twist.vector)).homogeneous for s in shares])
    way = way @ begin
    way[0], way[-1] = begin, end
    return way


def _with_middles(values: Array) -> Array:
    """Return rows (f, n) with the mean of each two neighbours inserted, shape (2 f - 1, n)."""
    dense = np.empty((2 * len(values) - 1, values.shape[1]))
    dense[::2], dense[1::2] = values, 0.5 * (values[:-1] + values[1:])
    return dense


def distance(first: Array, second: Array) -> float:
    """Return the distance between two poses (4, 4), m: translation plus lever arm times angle."""
    move = inverse(first) @ second
    angle = np.linalg.norm(Rotation.from_matrix(move[:3, :3]).as_rotvec())
    return float(np.linalg.norm(move[:3, 3]) + CYCLE_MOTION.lever_arm * angle)
