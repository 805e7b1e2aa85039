"""Whether the files of motion and force are on one clock.

On one clock the centre of pressure of a loaded foot lies under the foot's markers. On two clocks it
lies where the foot is at another time.
"""

from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.importing.plates import MAX_FOOT_DISTANCE, Feet, RecordedForce

# %: share of the loaded samples that must lie under the foot. Chosen because a few samples at foot
# strike and toe-off have a noisy centre of pressure.
PERCENTILE = 95.0
# Number of loaded samples that are compared. Chosen because they are dense in one stance.
SAMPLES = 400
# 1: share of the loaded samples that a shift must bring into the times of the motion. Chosen
# because a motion may be cut out of a longer recording.
SHARE = 0.5
# s: step of the shifts that are tried. Chosen because a foot in stance hardly moves in it.
STEP_S = 0.02


def check_clocks(forces: list[RecordedForce], feet: Feet, side: str, path: Path) -> None:
    """Raise an InputError if the forces lie under the foot only with their clock shifted.

    Args:
        forces: the forces of this foot, in the laboratory.
        feet: positions of the feet.
        side: side of the foot, "left" or "right".
        path: file of the forces, for the message.
    """
    time, point = _loaded_points(forces)
    middle = feet.middles[side]
    if not len(time) or not np.isfinite(middle).any():
        return
    apart, share = _distance(time, point, feet.time, middle)
    if share == 0.0 or apart <= MAX_FOOT_DISTANCE:
        return
    starts = [feet.time[0] - force.time[0] for force in forces]
    length = float(np.ptp(feet.time))
    shifts = [*starts, *np.arange(-length, length, STEP_S) - (time[0] - feet.time[0])]
    for shift in shifts:
        moved, share = _distance(time + shift, point, feet.time, middle)
        if share > SHARE and moved <= MAX_FOOT_DISTANCE:
            raise InputError(
                f"its centres of pressure lie up to {apart:.3g} m from the {side} foot, but under "
                f"it if {shift:+.3f} s is added to the times: force and motion are on two clocks",
                path,
                f"write the times of {feet.path.name} into it",
            )


def _loaded_points(forces: list[RecordedForce]) -> tuple[Array, Array]:
    """Return times (n,) s and centres of pressure (n, 3) m of some loaded samples."""
    times = [force.time[force.loaded] for force in forces]
    points = [force.point[force.loaded] for force in forces]
    time, point = np.concatenate(times), np.concatenate(points)
    every = max(len(time) // SAMPLES, 1)
    return time[::every], point[::every]


def _distance(time: Array, point: Array, clock: Array, middle: Array) -> tuple[float, float]:
    """Return the distance (m) that `percentile` of the points keep from the foot, and their share.

    The distance is horizontal. Only points at times of the motion count; the share is theirs.

    Args:
        time: (n,) s, times of the points.
        point: (n, 3) m.
        clock: (k,) s, times of the motion.
        middle: (k, 3) m, the foot.
    """
    seen = np.isfinite(middle).all(axis=1)
    inside = (time >= clock[seen][0]) & (time <= clock[seen][-1])
    if not inside.any():
        return np.inf, 0.0
    foot = [np.interp(time[inside], clock[seen], middle[seen, k]) for k in (0, 2)]
    apart = np.hypot(point[inside, 0] - foot[0], point[inside, 2] - foot[1])
    return float(np.percentile(apart, PERCENTILE)), float(inside.mean())
