"""What muscles do to the bones of a leg, frame by frame.

A taut line is a chain of straight parts between points on bones and on the wrap objects that
they carry. Inside a bone its tension is balanced; where a straight part leads from bone A at p to
bone B at q it pulls A at p along u = (q - p)/|q - p| and B at q along -u. So the line acts on a
bone through the straight parts that leave it, and through nothing else: they are the effective
attachments. Their wrenches are those whose virtual work is the moment arm,

    Σ_bones J_boneᵀ w_bone = -dL/dq.

Where a wrap object yields to a point that moves into it (see docs/opensim.md) the wrenches hold
what it pushes with, which no straight part shows. Path points that a model moves within their
bone (gait2392's quadriceps) add work of their own to -dL/dq, which is no wrench on any bone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import Array
from tkamb.io.opensim.paths import StraightParts


@dataclass(frozen=True, eq=False)
class Attachments:
    """Where muscles pull one bone towards another, in the first one's frame.

    Args:
        points: (f, m, 3) m; NaN where a muscle has no straight part between the two.
        directions: (f, m, 3) unit vectors of the pull.
    """

    points: Array
    directions: Array


@dataclass(frozen=True, eq=False)
class Bones:
    """The bones of a leg and what acts on them.

    Args:
        names: b bones, such as femur, patella, tibia, foot.
        muscles: m names.
        poses: (f, b, 4, 4) of each bone's first body in ground.
        pulls: (f, m, b, 6) moment above force of unit tension on each bone, in ground at
            ground's origin.
        demand: (f, b, 6) what the motion takes beyond gravity and external loads, likewise, N·m
            above N; see `required_wrenches`.
        crossings: straight parts from bone to bone, -1 for bodies of none.
    """

    names: tuple[str, ...]
    muscles: tuple[str, ...]
    poses: Array
    pulls: Array
    demand: Array
    crossings: StraightParts

    def pull_on(self, bones: Sequence[str], seen_from: str) -> Array:
        """Return the wrench (f, m, 6) of unit tension on some bones taken together.

        Moment (N·m per N) above force (N per N), in the frame of bone `seen_from` about its
        origin.
        """
        total = self.pulls[:, :, [self.index(name) for name in bones]].sum(axis=2)
        return self._seen(total, seen_from)

    def demand_of(self, bones: Sequence[str], seen_from: str) -> Array:
        """Return what the motion of some bones takes (f, 6), in the same way."""
        total = self.demand[:, [self.index(name) for name in bones]].sum(axis=1)
        return self._seen(total[:, None], seen_from)[:, 0]

    def attachments(self, bone: str, towards: str | None) -> Attachments:
        """Return where and along what muscles pull a bone towards another.

        A muscle that leads from the one to the other more than once has its last straight part
        here; its wrench is the sum of all (`pull_on`).

        Args:
            bone: whose frame, point and pull.
            towards: the other bone; None: any body that is no bone of the leg, as the pelvis.
        """
        here = self.index(bone)
        there = -1 if towards is None else self.index(towards)
        points = np.full((len(self.poses), len(self.muscles), 3), np.nan)
        directions = points.copy()
        for own, other in ((0, 1), (1, 0)):
            bodies = self.crossings.bodies
            part = self.crossings.chosen(
                np.flatnonzero((bodies[:, own] == here) & (bodies[:, other] == there))
            )
            pose = self.poses[part.frame, here]
            step = part.ends[:, other] - part.ends[:, own]
            step /= np.linalg.norm(step, axis=1, keepdims=True)
            arm = part.ends[:, own] - pose[:, :3, 3]
            where = part.frame, part.line
            points[where] = np.einsum("pji,pj->pi", pose[:, :3, :3], arm)
            directions[where] = np.einsum("pji,pj->pi", pose[:, :3, :3], step)
        return Attachments(points, directions)

    def index(self, name: str) -> int:
        """Return the place of a bone.

        Raises:
            InputError: no such bone.
        """
        if name not in self.names:
            raise InputError(f"no bone '{name}'", "muscles", names_near(name, self.names))
        return self.names.index(name)

    def _seen(self, wrench: Array, bone: str) -> Array:
        """Return wrenches (f, k, 6) of ground at its origin in a bone's frame about its own."""
        pose = self.poses[:, self.index(bone)]
        moment = wrench[..., :3] - np.cross(pose[:, None, :3, 3], wrench[..., 3:])
        rotation = pose[:, :3, :3]
        return np.concatenate([moment @ rotation, wrench[..., 3:] @ rotation], axis=-1)
