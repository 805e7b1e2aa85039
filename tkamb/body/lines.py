"""Lines of action: quadriceps and patellar ligament as massless strings between two links.

A unit tension on such a line, with the reaction of what it wraps, is one column of the
equations of motion; the moment arm about any knee coordinate q is then dL/dq.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tkamb.body.load import PointForces
from tkamb.body.wrapping import TautPath, loads_per_unit_tension, path_in_link
from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array, transform


@dataclass(frozen=True, eq=False)
class StringLine:
    """A string from a point of one link to a point of another, perhaps around a third.

    Args:
        name: "quadriceps" or "patellar_ligament", for messages and columns.
        start_link: link of the proximal end.
        start_point: (3,) m, in that link's frame.
        end_link: link of the distal end.
        end_point: (3,) m, in that link's frame.
        outline: (n, 2) m, convex sagittal outline it passes in front of; None: straight.
        outline_link: link to which the outline is fixed; it takes the wrap's reaction.
        pose_outline_in_link: (4, 4), the frame whose x-y plane holds the outline.
    """

    name: str
    start_link: str
    start_point: Array
    end_link: str
    end_point: Array
    outline: Array | None = None
    outline_link: str | None = None
    pose_outline_in_link: Array | None = None

    def path(self, poses: Mapping[str, Array]) -> TautPath:
        """Return the taut path in the insert frame, at one frame of the motion.

        Args:
            poses: link -> pose_link_in_insert (4, 4).

        Raises:
            ComputationError: an end lies inside the outline.
        """
        start = transform(poses[self.start_link], self.start_point)
        end = transform(poses[self.end_link], self.end_point)
        if self.outline is None or self.outline_link is None:
            return path_in_link(start, end, None, np.eye(4))
        pose = np.asarray(poses[self.outline_link], float)
        if self.pose_outline_in_link is not None:
            pose = pose @ self.pose_outline_in_link
        try:
            return path_in_link(start, end, self.outline, pose)
        except ComputationError as error:
            raise ComputationError(error.what, self.name) from None

    def loads(self, path: TautPath) -> tuple[PointForces, ...]:
        """Return the forces of a unit tension on the links: zero force and moment in sum."""
        return loads_per_unit_tension(path, self.start_link, self.end_link, self.outline_link)
