"""The rigid parts of a drawing: implant, patella, bones as plain solids, floor and foot.

If a muscle wraps around the mesh of a bone, this mesh is drawn. All other bones are simple bodies
of about the right size between the joint centres. They only help orientation. The pose of the foot
is not measured. The foot is drawn level with the floor and points forward with the shank.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from tkamb.geometry.frames import MIRROR, Array, inverse, pose, transform
from tkamb.geometry.surface import Surface
from tkamb.io.recordings.polygon_files import read_vtp, read_vtp_values
from tkamb.io.scene.case import Case
from tkamb.knee.chain import Chain, ChainState
from tkamb.knee.equations import KneeGeometry
from tkamb.knee.extensor import ExtensorLines
from tkamb.knee.knee import Knee
from tkamb.run.maps import ContactMaps
from tkamb.show.sections import WORN_NAME, wear_of_run
from tkamb.show.style import BLACK
from tkamb.show.view.drawing import BONE, BUTTON, FLOOR, INSERT, METAL, RECORDED, Marker, Solid
from tkamb.show.view.lines import centre_of_pressure
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.run.results import Results

FEMUR_PROFILE = (
    (0.015, 19.0),
    (0.045, 21.0),
    (0.10, 15.0),
    (0.25, 12.5),
    (0.80, 13.0),
    (0.93, 17.0),
    (1.0, 20.0),
)
TIBIA_PROFILE = ((0.0, 26.0), (0.05, 24.0), (0.16, 15.0), (0.50, 11.0), (0.85, 11.0), (1.0, 18.0))
"""Pairs of distance from the knee, as a share of the bone's length, and radius, mm."""

PATELLA_DEPTH, PATELLA_WIDTH = 8.0 * MILLIMETRE, 21.0 * MILLIMETRE

INSTEP = (15.0, 42.0, 0.0, 22.0)
SOLE = (
    (-48.0, 26.0, 0.0, 26.0),
    (75.0, 26.0, 0.0, 22.0),
    (125.0, 18.0, -24.0, 18.0),
    (115.0, 16.0, 26.0, 16.0),
    (172.0, 11.0, -20.0, 11.0),
    (160.0, 10.0, 22.0, 10.0),
)
"""mm: balls whose convex hull is the foot. Each has a centre (anterior to the ankle, above the
sole, to the right) and a radius."""


# mm: radius of the ball at the ankle. Chosen by eye.
ANKLE_RADIUS_MM = 20.0
# m: distance from the ankle to the floor's centre in front of it. It is about the
# middle of a foot.
PLATE_CENTRE = 60.0 * MILLIMETRE


PLATE = np.array([340.0, 5.0, 200.0]) * MILLIMETRE
GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
"""rad: golden angle. Points of a spiral that are this angle apart cover a sphere evenly."""


def solids(
    case: Case,
    recorded: Array,
    states: Sequence[ChainState],
    maps: ContactMaps | None,
    rows: Sequence[int],
) -> tuple[Solid, ...]:
    """Return the solids of a case.

    The femoral component has the pose of the contact model. In frames without a map it has the
    pose of `states`.

    Args:
        recorded: recorded pose_femur_in_insert, shape (f, 4, 4).
        states: state of the chain in each frame.
        maps: pressure maps of the run, each with the pose of the femoral component.
        rows: row of the map of each frame; -1: the frame has no map.
    """
    solved = np.stack([state.pose("femur") for state in states])
    still = np.eye(4)[None]
    result = []
    if case.insert is not None:
        result.append(Solid("insert", "insert", case.insert, INSERT, 1.0, still))
    if case.post is not None:
        result.append(Solid("post", "insert", case.post, INSERT, 1.0, still))
    if case.femoral is not None:
        poses = contact_poses(solved, maps, rows)
        result.append(
            Solid("femoral component", "femoral component", case.femoral, METAL, 0.5, poses)
        )
        result.append(
            Solid(
                "recorded femoral component",
                "recorded pose",
                case.femoral,
                RECORDED,
                0.35,
                recorded,
            )
        )
    result += [_femur(case, states, solved), _tibia(states)]
    return tuple(result)


def patella_solids(knee: Knee, poses: Array) -> tuple[Solid, ...]:
    """Return patella and button at poses (f, 4, 4) in the insert frame; () without a patella."""
    if knee.extensor_lines is None:
        return ()
    button = Solid("patellar button", "patella", knee.button, BUTTON, 1.0, poses)
    bone = _patella(knee.extensor_lines, knee.chain)
    return (button, Solid("patella", "patella", bone, BONE, 0.55, poses))


def worn_insert(results: "Results", side: str) -> tuple[Solid, ...]:
    """Return the worn insert that `tkamb wear` wrote, coloured by wear depth; () if there is none.

    Args:
        results: results of a run. Their folder may have wear.vtp of the same scene.
        side: side of the knee. The drawing mirrors a left knee, wear.vtp does not.

    Raises:
        InputError: wear.json or wear.vtp cannot be read.
    """
    if not wear_of_run(results):
        return ()
    assert results.directory is not None
    path = results.directory / WORN_NAME
    points, faces = read_vtp(path)
    depth = read_vtp_values(path, "wear_depth_mm")
    if side == "left":
        points, faces = points @ MIRROR, faces[:, ::-1]
    surface = Surface(points, faces, "worn insert")
    return (Solid(surface.name, "worn insert", surface, INSERT, 1.0, np.eye(4)[None], depth),)


def contact_poses(without_map: Array, maps: ContactMaps | None, rows: Sequence[int]) -> Array:
    """Return the pose (f, 4, 4) of the femoral component in its contact, else that without a map.

    Args:
        without_map: pose_femur_in_insert of the equations, shape (f, 4, 4).
        maps: pressure maps of the run; None: there are none.
        rows: row of the map of each frame; -1: the frame has no map.
    """
    poses = without_map.copy()
    if maps is not None:
        stored = maps.femoral_pose
        for frame, row in enumerate(rows):
            if row >= 0 and np.isfinite(stored[row]).all():
                poses[frame] = stored[row]
    return poses


def _femur(case: Case, states: Sequence[ChainState], poses: Array) -> Solid:
    """Return the femur that a muscle wraps around, or else a simple bone up to the hip."""
    bone = case.bone
    if bone is not None:
        return Solid("femur", "bones", bone, BONE, 1.0, poses)
    hip = (inverse(poses[0]) @ np.append(states[0].point("hip", np.zeros(3)), 1.0))[:3]
    return Solid("femur", "bones", _shaft(hip, FEMUR_PROFILE, "femur"), BONE, 1.0, poses)


def _tibia(states: Sequence[ChainState]) -> Solid:
    """Return the tibia below the insert's bottom, down to the ankle."""
    ankle = states[0].point("tibia", np.zeros(3))
    surface = _shaft(ankle, TIBIA_PROFILE, "tibia")
    return Solid("tibia", "bones", surface, BONE, 1.0, np.eye(4)[None])


def _shaft(end: Array, profile: tuple[tuple[float, float], ...], name: str) -> Surface:
    """Return a body of revolution from the origin towards `end` (3,)."""
    length = float(np.linalg.norm(end))
    share, radius = np.array(profile).T
    at = np.linspace(share[0], share[-1], 24)
    radii = np.interp(at, share, radius * MILLIMETRE)
    return revolved(radii, length * at, name).moved(_turned([0.0, 0.0, 1.0], end))


def _patella(lines: ExtensorLines, chain: Chain) -> Surface:
    """Return an ellipsoid from the tendon's insertion to the ligament's origin."""
    ends = (lines.muscle.points[-1], lines.ligament.points[0])
    top, bottom = (transform(chain.link_in(end.link, "patella"), end.position) for end in ends)
    radii = np.array([PATELLA_DEPTH, 0.5 * float(np.linalg.norm(top - bottom)), PATELLA_WIDTH])
    rotation = _turned([0.0, 1.0, 0.0], top - bottom)
    rotation[:3, 3] = 0.5 * (top + bottom)
    return hull(sphere_points() * radii, "patella").moved(rotation)


def _turned(axis: ArrayLike, towards: Array) -> Array:
    """Return the smallest rotation (4, 4) that aligns an axis (3,) with a direction (3,)."""
    rotation, _ = Rotation.align_vectors(np.atleast_2d(towards), np.atleast_2d(axis))
    return pose(rotation.as_matrix(), np.zeros(3))


def floor_and_foot(
    case: Case, geometries: Sequence[KneeGeometry], frames: Sequence[int]
) -> tuple[tuple[Solid, ...], tuple[Marker, ...]]:
    """Return floor, foot and centre of pressure; empty without a force plate.

    Args:
        geometries: geometry of each frame.
        frames: index of each frame in the motion.
    """
    table = case.scene.ground_reaction
    if case.ground is None or case.tibia is None or table is None or table.applied == "ankle":
        return (), ()
    floor = float(np.median(case.ground.point[:, 1]))
    tibias = case.tibia.pose[list(frames)]
    grounds = np.stack(
        [_floor_pose(one, tibia, floor) for one, tibia in zip(geometries, tibias, strict=True)]
    )
    lowest = float((tibias[:, 1, 3] - floor).min())
    feet = grounds.copy()
    feet[:, :3, 3] += (tibias[:, 1, 3] - floor - lowest)[:, None] * grounds[:, :3, 1]
    slab = box(PLATE, "floor").moved(pose(np.eye(3), [PLATE_CENTRE, -0.5 * PLATE[1], 0.0]))
    plate = Solid("floor", "floor", slab, FLOOR, 0.6, grounds)
    foot = Solid("foot", "bones", _foot_surface(lowest), BONE, 1.0, feet)
    points = np.stack([centre_of_pressure(one) for one in geometries])
    marker = Marker("centre of pressure", "floor", BLACK, points, 5.0 * MILLIMETRE)
    return (plate, foot), (marker,)


def _floor_pose(geometry: KneeGeometry, tibia_in_laboratory: Array, floor: float) -> Array:
    """Return the floor's pose (4, 4) in the insert frame: origin below the ankle, y up."""
    laboratory = geometry.state.pose("tibia") @ inverse(tibia_in_laboratory)
    up = laboratory[:3, 1]
    ahead = np.array([1.0, 0.0, 0.0]) - up[0] * up
    ahead /= np.linalg.norm(ahead)
    below = tibia_in_laboratory[:3, 3].copy()
    below[1] = floor
    axes = np.column_stack([ahead, up, np.cross(ahead, up)])
    return pose(axes, transform(laboratory, below))


def _foot_surface(height: float) -> Surface:
    ankle = (0.0, height / MILLIMETRE, 0.0, ANKLE_RADIUS_MM)
    sole, leg = _hull((*SOLE, INSTEP)), _hull((INSTEP, ankle))
    faces = np.concatenate([sole.faces, leg.faces + len(sole.vertices)])
    return Surface(np.concatenate([sole.vertices, leg.vertices]), faces, "foot")


def _hull(balls: Sequence[tuple[float, ...]]) -> Surface:
    points = [sphere_points() * radius + centre for *centre, radius in balls]
    return hull(np.concatenate(points) * MILLIMETRE, "balls")


def hull(points: Array, name: str) -> Surface:
    """Return the convex hull of points (n, 3), m. Its triangles are oriented outwards."""
    result = ConvexHull(points)
    faces = result.simplices
    a, b, c = np.moveaxis(points[faces], 1, 0)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), result.equations[:, :3]) < 0
    faces = np.where(inward[:, None], faces[:, ::-1], faces)
    place = np.full(len(points), -1)
    place[result.vertices] = np.arange(len(result.vertices))
    return Surface(points[result.vertices], place[faces], name)


def sphere_points(count: int = 640) -> Array:
    """Return points (n, 3) spread evenly over the unit sphere, on a spiral of golden angles."""
    k = np.arange(count) + 0.5
    up = 1.0 - 2.0 * k / count
    across = np.sqrt(1.0 - up**2)
    return np.column_stack([across * np.cos(GOLDEN * k), up, across * np.sin(GOLDEN * k)])


def box(size: Array, name: str) -> Surface:
    """Return a box of a size (3,), m, centred at the origin."""
    corners = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])).reshape(3, 8).T
    return hull(corners * size, name)


def revolved(radius: Array, height: Array, name: str, sections: int = 28) -> Surface:
    """Return a body of revolution about z with flat ends.

    Args:
        radius: radii, m, shape (n,).
        height: increasing z of the radii, m, shape (n,).
    """
    count, angle = len(radius), 2.0 * np.pi * np.arange(sections) / sections
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    around = np.concatenate(
        [radius[:, None, None] * ring, np.tile(height[:, None, None], (1, sections, 1))], axis=2
    )
    poles = [[0.0, 0.0, height[0]], [0.0, 0.0, height[-1]]]
    first = np.arange(sections)
    second = (first + 1) % sections
    low = (sections * np.arange(count - 1))[:, None]
    a, b, c, d = low + first, low + second, low + second + sections, low + first + sections
    bottom, top = count * sections, count * sections + 1
    last = (count - 1) * sections
    faces = np.concatenate(
        [
            np.stack([a, b, c], axis=2).reshape(-1, 3),
            np.stack([a, c, d], axis=2).reshape(-1, 3),
            np.column_stack([np.full(sections, bottom), second, first]),
            np.column_stack([np.full(sections, top), last + first, last + second]),
        ]
    )
    return Surface(np.concatenate([around.reshape(-1, 3), poles]), faces, name)
