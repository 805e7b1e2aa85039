"""Poses as 4x4 matrices and the knee coordinates of Grood and Suntay.

`pose_A_in_B` maps points from frame A to frame B; the functions broadcast over leading axes.

The axes of the insert frame are x anterior, y superior, z to the right. The pose of the femoral
component of a right knee (left knees are mirrored at input) is

    R = Ry(-axial_rotation) Rx(-adduction) Rz(flexion),   t = (ap, si, ml)

with flexion about the femoral ML axis (positive in flexion), adduction about the floating axis
(positive: varus), and axial rotation about the tibial SI axis (positive: femur external).

Reference: Grood & Suntay, J Biomech Eng 105:136 (1983), doi:10.1115/1.3138397.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

KNEE_COORDINATES = ("ap", "si", "ml", "axial_rotation", "adduction", "flexion")
"""Order of the six knee coordinates: translations (m), then rotations (rad)."""

KNEE_JOINT_NAMES = tuple(f"knee_{name}" for name in KNEE_COORDINATES)
"""Names of the six joints in the URDF, in the same order."""

PATELLA_COORDINATES = PATELLA_JOINT_NAMES = ("patella_ap", "patella_si", "patella_rotation")
"""Coordinates of the patella in the femur's sagittal plane (m, m, rad), and names of its joints."""
PATELLA_BODY_COORDINATES = ("ap", "si", "shift", "flexion", "tilt", "rotation")
"""Coordinates of a patella with six degrees of freedom (`tkamb.knee.patella_body`), m and rad."""

SIDES = ("medial", "lateral")
"""Names of the condyles."""

_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
_ALONG = np.eye(3)
_CROSS = np.cross(_ALONG[:, None], _ALONG).swapaxes(1, 2).reshape(3, 9)
"""The matrices of the cross product with x, y and z."""
_TURNS = np.array([-1.0, -1.0, 1.0])
"""Signs of axial rotation, adduction and flexion as rotations about y, x and z."""


def pose(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Return the pose(s) (..., 4, 4) with rotation (..., 3, 3) and translation (..., 3)."""
    rotation, translation = np.asarray(rotation, float), np.asarray(translation, float)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    result = np.zeros((*shape, 4, 4))
    result[..., :3, :3] = rotation
    result[..., :3, 3] = translation
    result[..., 3, 3] = 1.0
    return result


def inverse(pose_a_in_b: ArrayLike) -> Array:
    """Return pose_b_in_a (..., 4, 4)."""
    pose_a_in_b = np.asarray(pose_a_in_b, float)
    transposed = np.swapaxes(pose_a_in_b[..., :3, :3], -1, -2)
    return pose(transposed, -np.einsum("...ij,...j->...i", transposed, pose_a_in_b[..., :3, 3]))


def transform(pose_a_in_b: ArrayLike, points: ArrayLike) -> Array:
    """Return points of frame A in frame B.

    Args:
        pose_a_in_b: (4, 4), or (f, 4, 4) for f poses.
        points: (n, 3) or (3,), or (f, n, 3) for different points at f poses.
    """
    pose_a_in_b, points = np.asarray(pose_a_in_b, float), np.asarray(points, float)
    rotation, translation = pose_a_in_b[..., :3, :3], pose_a_in_b[..., :3, 3]
    if points.ndim == 1:
        return np.einsum("...ij,j->...i", rotation, points) + translation
    return np.einsum("...ij,...nj->...ni", rotation, points) + translation[..., None, :]


def rotate(pose_a_in_b: ArrayLike, vectors: ArrayLike) -> Array:
    """Return free vectors (n, 3) or (3,) of frame A in frame B."""
    rotation = np.asarray(pose_a_in_b, float)[..., :3, :3]
    vectors = np.asarray(vectors, float)
    if vectors.ndim == 1:
        return np.einsum("...ij,j->...i", rotation, vectors)
    return np.einsum("...ij,...nj->...ni", rotation, vectors)


def cross(a: Array, b: Array) -> Array:
    """Return `np.cross` of vectors (..., 3), faster by 40 µs per call."""
    if a.ndim == b.ndim == 1:
        (x, y, z), (u, v, w) = a.tolist(), b.tolist()
        return np.array([y * w - z * v, z * u - x * w, x * v - y * u])
    return a.take(_NEXT, -1) * b.take(_LAST, -1) - a.take(_LAST, -1) * b.take(_NEXT, -1)


def cross_matrix(vectors: Array) -> Array:
    """Return the matrices (..., 3, 3) of the cross product with vectors (..., 3)."""
    return (vectors @ _CROSS).reshape(*vectors.shape, 3)


def knee_pose(coordinates: ArrayLike) -> Array:
    """Return pose_femoral_in_insert (..., 4, 4) from knee coordinates (..., 6), m and rad."""
    c: Any = np.asarray(coordinates, float)
    if c.ndim == 1:
        return _pose_of_knee(c.tobytes()).copy()
    return _poses_of_knee(c)


@lru_cache(maxsize=32)
def _pose_of_knee(coordinates: bytes) -> Array:
    """A search needs the same pose repeatedly."""
    return _poses_of_knee(np.frombuffer(coordinates))


def _poses_of_knee(c: Any) -> Array:
    """Return (..., 4, 4) by the expanded product of the three rotations."""
    (sa, sb, sg), (ca, cb, cg) = (
        np.moveaxis(f(_TURNS * c[..., 3:]), -1, 0) for f in (np.sin, np.cos)
    )
    result = np.zeros((*c.shape[:-1], 4, 4))
    result[..., 0, 0], result[..., 0, 1] = ca * cg + sa * sb * sg, sa * sb * cg - ca * sg
    result[..., 1, 0], result[..., 1, 1] = cb * sg, cb * cg
    result[..., 2, 0], result[..., 2, 1] = ca * sb * sg - sa * cg, sa * sg + ca * sb * cg
    result[..., 0, 2], result[..., 1, 2], result[..., 2, 2] = sa * cb, -sb, ca * cb
    result[..., :3, 3], result[..., 3, 3] = c[..., :3], 1.0
    return result


def knee_coordinates(pose_femoral_in_insert: ArrayLike) -> Array:
    """Return knee coordinates (..., 6) from pose_femoral_in_insert (..., 4, 4).

    The angles are unwrapped along the first axis, so that they do not jump by 360 deg.
    """
    p = np.asarray(pose_femoral_in_insert, float)
    r = p[..., :3, :3]  # see `_poses_of_knee`
    first, third = np.arctan2(r[..., 0, 2], r[..., 2, 2]), np.arctan2(r[..., 1, 0], r[..., 1, 1])
    second = np.arctan2(-r[..., 1, 2], np.hypot(r[..., 1, 0], r[..., 1, 1]))
    angles = np.stack([first, second, third], axis=-1) * _TURNS
    if angles.ndim > 1:
        angles = np.unwrap(angles, axis=0)
    return np.concatenate([p[..., :3, 3], angles], axis=-1)


MIRROR = np.diag([1.0, 1.0, -1.0])
"""Reflection in the sagittal plane, from a left knee to a right one."""


def mirrored_pose(pose_a_in_b: ArrayLike) -> Array:
    """Return the pose (..., 4, 4) of mirrored frame A in mirrored frame B."""
    p = np.asarray(pose_a_in_b, float)
    return pose(MIRROR @ p[..., :3, :3] @ MIRROR, p[..., :3, 3] @ MIRROR)


def knee_twist(coordinates: ArrayLike, rates: ArrayLike) -> tuple[Array, Array]:
    """Return the femur's velocity relative to the insert, insert frame.

    `rates` (..., 6) are those of the knee `coordinates`, m/s and rad/s. The result is the velocity
    (..., 3), m/s, of the femoral origin, and the angular velocity (..., 3), rad/s.
    """
    rate = np.asarray(rates, float)
    return rate[..., :3], np.einsum("...i,...ij->...j", rate, knee_axes(coordinates)[..., 3:])


def knee_axes(coordinates: ArrayLike) -> Array:
    """Return the femur's twist per unit rate of each knee coordinate.

    The generalised forces of a wrench w on the femur (force, then moment about the insert's origin)
    are `knee_axes(q) @ w`.

    Returns:
        (..., 6, 6), insert frame. Row i is the twist for a unit rate of coordinate i: the velocity
        of the femur's point at the insert's origin, then the angular velocity.
    """
    c = np.asarray(coordinates, float)
    return _axes_of_knee(c.tobytes()).copy() if c.ndim == 1 else _axes_of_knees(c)


@lru_cache(maxsize=32)
def _axes_of_knee(coordinates: bytes) -> Array:
    return _axes_of_knees(np.frombuffer(coordinates))


def _axes_of_knees(c: Array) -> Array:
    axes = np.zeros((*c.shape[:-1], 6, 6))
    axes[..., :3, :3] = _ALONG
    turn, tilt = c[..., 3], c[..., 4]
    axes[..., 3, 4] = -1.0
    axes[..., 4, 3], axes[..., 4, 5] = -np.cos(turn), -np.sin(turn)
    axes[..., 5, 3] = -np.sin(turn) * np.cos(tilt)
    axes[..., 5, 4] = np.sin(tilt)
    axes[..., 5, 5] = np.cos(turn) * np.cos(tilt)
    axes[..., 3:, :3] = cross(c[..., None, :3], axes[..., 3:, 3:])
    return axes


def sagittal_pose(coordinates: Array) -> Array:
    """Return the pose (4, 4) at ap, si (m) and a rotation about z (rad) in the sagittal plane."""
    ap, si, rotation = coordinates
    c, s = np.cos(rotation), np.sin(rotation)
    result = np.eye(4)
    result[:2, :2], result[:2, 3] = [[c, -s], [s, c]], [ap, si]
    return result


def displaced(femur_pose: Array, displacement: Array) -> Array:
    """Return a pose (4, 4) moved by translation and rotation vector (6,), insert frame, about its
    origin.
    """
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec(displacement[3:]).as_matrix()
    return pose(rotation @ femur_pose[:3, :3], rotation @ femur_pose[:3, 3] + displacement[:3])
