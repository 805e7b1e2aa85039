"""Sliding of the femoral component over points of the insert, from femoral poses."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio

from tkamb.geometry.frames import Array, inverse


def step_twists(poses: Array) -> Array:
    """Return the spatial twist of the screw motion from each pose to the next, shape (f - 1, 6).

        exp(twist) = pose_{k+1} pose_k^-1

    The linear part, m, comes first. It is the velocity of the femoral material at the origin of the
    insert frame times the duration of the step. The angular part, rad, follows.

    Args:
        poses: pose_femoral_in_insert, shape (f, 4, 4).
    """
    moves = poses[1:] @ inverse(poses[:-1])
    return np.array([pinocchio.log6(pinocchio.SE3(move)).vector for move in moves]).reshape(-1, 6)


def step_sliding(poses: Array, points: Array, normals: Array) -> Array:
    """Return the sliding path of the femoral surface over each point, m, shape (f - 1, n, 3).

    In a screw motion the femoral material at a fixed point x has the constant velocity
    v + omega × x, which is zero for pure rolling. The path of a step is therefore exact for
    rotations of any size. The component along the insert's normal is removed.

    Args:
        poses: pose_femoral_in_insert, shape (f, 4, 4).
        points: points on the insert, m, shape (n, 3).
        normals: unit outward normals of the insert at the points, shape (n, 3).
    """
    twists = step_twists(poses)
    path = twists[:, None, :3] + np.cross(twists[:, None, 3:], points[None])
    along = np.einsum("snj,nj->sn", path, normals)
    return path - along[..., None] * normals


@dataclass(frozen=True, eq=False)
class SlidingHistory:
    """Pressure and sliding at points of the insert in each step of a cycle.

    Args:
        pressure: mean pressure of each step, Pa, shape (s, n); zero without contact.
        sliding: sliding path of the femoral surface in the tangent plane, m, shape (s, n, 3).
        normals: unit outward normals of the insert, shape (n, 3).
        passes: passes through the steps per cycle: 2 for a motion there and back.
        seconds: duration of each step, s, shape (s,); None: equal steps.
    """

    pressure: Array
    sliding: Array
    normals: Array
    passes: int = 1
    seconds: Array | None = None

    @classmethod
    def of_cycle(
        cls,
        poses: Array,
        pressure: Array,
        points: Array,
        normals: Array,
        passes: int = 1,
        seconds: Array | None = None,
    ) -> "SlidingHistory":
        """Return the history of frames with poses (f, 4, 4) and pressure maps (f, n).

        The pressure of a step is the mean of its two frames. Sums over the cycle are therefore
        trapezoidal rules, of second order in the step.
        """
        between = 0.5 * (pressure[:-1] + pressure[1:])
        return cls(between, step_sliding(poses, points, normals), normals, passes, seconds)

    @cached_property
    def length(self) -> Array:
        """Path length of each step, m, shape (s, n)."""
        return np.linalg.norm(self.sliding, axis=2)

    @cached_property
    def work(self) -> Array:
        """Pressure times path, N/m, shape (s, n): work of friction per area for coefficient 1."""
        return self.pressure * self.length

    @cached_property
    def total_work(self) -> Array:
        """Sum of `work` over the cycle, N/m, shape (n,)."""
        return self.passes * self.work.sum(axis=0)

    @cached_property
    def distance(self) -> Array:
        """Path over each point in contact per cycle, m, shape (n,)."""
        return self.passes * np.where(self.pressure > 0, self.length, 0.0).sum(axis=0)

    @cached_property
    def mean_pressure(self) -> Array:
        """Time-mean pressure of the whole cycle, Pa, shape (n,)."""
        return np.average(self.pressure, axis=0, weights=self.seconds)

    @cached_property
    def cross_shear(self) -> Array:
        """Cross-shear ratio, shape (n,), see `cross_shear_ratio`; zero without sliding."""
        return cross_shear_ratio(self.work, self.sliding, self.normals)


def cross_shear_ratio(work: Array, sliding: Array, normals: Array) -> Array:
    """Return the share of the work of friction across the principal direction, shape (n,).

    The work w of a step in the direction t of the tangent plane has the parts w cos²(t - a) along
    and w sin²(t - a) across a direction a. Their sums over the cycle are the quadratic forms of

        M = sum over steps of w d dᵀ,      d the unit direction of sliding

    The principal direction has the largest work along it. It is the eigenvector of the larger
    eigenvalue of M, and the cross-shear ratio is

        CS = lambda_min / (lambda_min + lambda_max)

    Under constant pressure CS is A/(A + B) for a rectangular path with sides A <= B, 1/2 for a
    circle and 0 for a line.

    Args:
        work: pressure times path, N/m, shape (s, n).
        sliding: sliding path in the tangent plane, m, shape (s, n, 3).
        normals: unit normals, shape (n, 3).

    References:
        Wang, Wear 248:38 (2001): molecules align with the principal direction of sliding and are
        torn by work across it; Turell et al., Wear 259:984 (2005): rectangular paths, A/(A + B).
    """
    first, second = _tangents(normals)
    u = np.einsum("snj,nj->sn", sliding, first)
    v = np.einsum("snj,nj->sn", sliding, second)
    square = u**2 + v**2
    share = np.divide(work, square, out=np.zeros_like(work), where=square > 0)
    uu, vv, uv = ((share * a).sum(axis=0) for a in (u * u, v * v, u * v))
    total = uu + vv
    difference = np.hypot(uu - vv, 2.0 * uv)  # lambda_max - lambda_min
    ratio = np.divide(total - difference, 2.0 * total, out=np.zeros_like(total), where=total > 0)
    return np.clip(ratio, 0.0, 0.5)


def _tangents(normals: Array) -> tuple[Array, Array]:
    """Return two perpendicular unit vectors (n, 3) in the tangent plane of each normal."""
    axis = np.eye(3)[np.abs(normals).argmin(axis=1)]  # the axis farthest from the normal
    first = np.cross(normals, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)
