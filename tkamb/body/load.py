"""Point forces, and the one place that turns them into generalised forces."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from tkamb.geometry.frames import Array


@dataclass(frozen=True, eq=False)
class PointForces:
    """Forces on one link, at one frame of the motion.

    Args:
        link: name of the URDF link that takes them.
        points: (m, 3) m, where they act, in the insert frame.
        forces: (m, 3) N, or N per unit of an unknown magnitude, in the insert frame.
        moment: (3,) N·m, free moment on the same link.
    """

    link: str
    points: Array
    forces: Array
    moment: Array = field(default_factory=lambda: np.zeros(3))

    def wrench_at(self, point: Array) -> Array:
        """Return force and moment (6,) about `point` (3,), insert frame."""
        moments = np.cross(self.points - point, self.forces).sum(axis=0)
        return np.concatenate([self.forces.sum(axis=0), moments + self.moment])


def total_wrench(loads: Iterable[PointForces], point: Array) -> Array:
    """Return the summed force and moment (6,) of several loads about `point` (3,)."""
    return np.sum([load.wrench_at(point) for load in loads], axis=0)
