"""The motion that one cycle consists of: poses of the femoral component, and the load at each."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, inverse
from tkamb.wear.force_control import ForceDrive

LEVER = 0.025
"""m; what a turn moves at a condyle, to compare turns with translations."""
CLOSES_WITHIN = 0.1
"""Share of the motion's extent by which its ends may differ and it still is a closed cycle."""


@dataclass(frozen=True, eq=False)
class CycleMotion:
    """One cycle.

    Args:
        poses: (f, 4, 4) pose_femoral_in_insert; the press keeps rotation, x and z.
        load: (f,) N along -y.
        duration: s of a cycle.
        passes: how often the frames are gone through in a cycle: 1 for a closed cycle, 2 where
            the way back is the way out.
        notes: what a reader must know about it.
        drive: finds the poses anew on every insert, from forces; None: they are prescribed. Those
            of a driven motion are where its first search begins.
    """

    poses: Array
    load: Array
    duration: float
    passes: int = 1
    notes: tuple[str, ...] = ()
    drive: ForceDrive | None = None

    def __len__(self) -> int:
        return len(self.load)

    @classmethod
    def of_frames(cls, time: Array, poses: Array, load: Array) -> "CycleMotion":
        """Return the cycle that recorded frames stand for.

        Frames whose ends meet are a closed cycle, with the step from the last frame to the
        first. Others are gone through there and back.

        Args:
            time: (f,) s.
            poses: (f, 4, 4); NaN where a frame failed.
            load: (f,) N; NaN where a frame failed.

        Raises:
            InputError: fewer than two frames are left.
        """
        known = np.isfinite(load) & np.isfinite(poses).all(axis=(1, 2))
        notes = []
        if lost := int((~known).sum()):
            notes.append(f"{lost} of {len(known)} frames failed and are left out of the cycle")
        time, poses, load = time[known], poses[known], load[known]
        if len(time) < 2:
            raise InputError("fewer than two frames have a contact", "wear", "see the run's status")
        apart = [distance(poses[0], pose) for pose in poses]
        span = float(time[-1] - time[0])
        if apart[-1] > CLOSES_WITHIN * max(apart):
            notes.append("the motion's ends do not meet: a cycle is the motion there and back")
            return cls(poses, load, 2.0 * span, 2, tuple(notes))
        notes.append("a closed cycle, with the step from the last frame to the first")
        step = span / (len(time) - 1)
        poses, load = np.concatenate([poses, poses[:1]]), np.append(load, load[0])
        return cls(poses, load, span + step, 1, tuple(notes))

    def thinned(self, most: int) -> "CycleMotion":
        """Return at most `most` frames, evenly chosen, the ends kept."""
        if len(self) <= most:
            return self
        chosen = np.unique(np.linspace(0, len(self) - 1, most).round().astype(int))
        note = f"{len(chosen)} of its {len(self)} frames are computed"
        notes = (*self.notes, note)
        return replace(self, poses=self.poses[chosen], load=self.load[chosen], notes=notes)


def distance(one: Array, other: Array) -> float:
    """Return how far apart two poses (4, 4) are, m, a turn counted at `LEVER`."""
    move = inverse(one) @ other
    turn = np.linalg.norm(Rotation.from_matrix(move[:3, :3]).as_rotvec())
    return float(np.linalg.norm(move[:3, 3]) + LEVER * turn)
