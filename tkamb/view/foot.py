"""What the ground reaction stands on: the floor, a plain foot, and the centre of pressure.

Nobody measured the foot: it hangs at the ankle, level with the floor and pointing where the
shank does, so that the arrow of the ground reaction does not hang in the air.
"""

from collections.abc import Sequence

import numpy as np
import trimesh

from tkamb.body.knee import KneeGeometry
from tkamb.geometry.frames import Array, inverse, pose, transform
from tkamb.geometry.surface import Surface
from tkamb.scene.case import Case
from tkamb.units import MILLIMETRE
from tkamb.view.arrows import centre_of_pressure
from tkamb.view.colours import BLACK, BONE, FLOOR
from tkamb.view.drawing import Marker, Solid

INSTEP = (15.0, 42.0, 0.0, 22.0)
SOLE = (
    (-48.0, 26.0, 0.0, 26.0),
    (75.0, 26.0, 0.0, 22.0),
    (125.0, 18.0, -24.0, 18.0),
    (115.0, 16.0, 26.0, 16.0),
    (172.0, 11.0, -20.0, 11.0),
    (160.0, 10.0, 22.0, 10.0),
)
"""Balls in whose hull the foot lies: anterior of the ankle, above the sole, right; radius; mm."""

ANKLE_RADIUS = 20.0
"""mm."""
PLATE = np.array([340.0, 5.0, 200.0]) * MILLIMETRE
PLATE_CENTRE = 60.0 * MILLIMETRE
"""m, anterior of the ankle."""


def standing(
    case: Case, geometries: Sequence[KneeGeometry], frames: Sequence[int]
) -> tuple[tuple[Solid, ...], tuple[Marker, ...]]:
    """Return floor and foot, and the centre of pressure; nothing without a force plate.

    Args:
        case: the case.
        geometries: of the frames.
        frames: of the motion.
    """
    table = case.scene.ground_reaction
    if case.ground is None or case.tibia is None or table is None or table.applied == "ankle":
        return (), ()
    floor = float(np.median(case.ground.point[:, 1]))
    ankles = case.tibia.pose[list(frames), :3, 3]
    grounds = np.stack(
        [_ground(one, case.tibia.pose[k], floor) for one, k in zip(geometries, frames, strict=True)]
    )
    lowest = float((ankles[:, 1] - floor).min())
    feet = grounds.copy()
    feet[:, :3, 3] += (ankles[:, 1] - floor - lowest)[:, None] * grounds[:, :3, 1]
    plate = Solid("floor", "floor", _plate(), FLOOR, 0.6, grounds)
    foot = Solid("foot", "bones", _foot(lowest), BONE, 1.0, feet)
    points = np.stack([centre_of_pressure(one) for one in geometries])
    marker = Marker("centre of pressure", "floor", BLACK, points, 5.0 * MILLIMETRE)
    return (plate, foot), (marker,)


def _ground(geometry: KneeGeometry, tibia_in_laboratory: Array, floor: float) -> Array:
    """Return the pose (4, 4) in the insert frame of the floor under the ankle, y up."""
    laboratory = geometry.state.pose("tibia") @ inverse(tibia_in_laboratory)
    up = laboratory[:3, 1]
    ahead = np.array([1.0, 0.0, 0.0]) - up[0] * up
    ahead /= np.linalg.norm(ahead)
    below = tibia_in_laboratory[:3, 3].copy()
    below[1] = floor
    axes = np.column_stack([ahead, up, np.cross(ahead, up)])
    return pose(axes, transform(laboratory, below))


def _plate() -> Surface:
    box = trimesh.creation.box(PLATE)
    box.apply_translation([PLATE_CENTRE, -0.5 * PLATE[1], 0.0])
    return Surface(np.asarray(box.vertices), np.asarray(box.faces, np.int64), "floor")


def _foot(height: float) -> Surface:
    """Return a foot whose ankle is `height` (m) above the sole."""
    ankle = (0.0, height / MILLIMETRE, 0.0, ANKLE_RADIUS)
    parts = [_hull((*SOLE, INSTEP)), _hull((INSTEP, ankle))]
    first = len(parts[0].vertices)
    vertices = np.concatenate([part.vertices for part in parts])
    return Surface(vertices, np.concatenate([parts[0].faces, parts[1].faces + first]), "foot")


def _hull(balls: Sequence[tuple[float, ...]]) -> trimesh.Trimesh:
    """Return the hull of balls: centre and radius in mm."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    points = [ball.vertices * radius + centre for *centre, radius in balls]
    return trimesh.convex.convex_hull(np.concatenate(points) * MILLIMETRE)
