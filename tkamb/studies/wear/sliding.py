"""Sliding of the femoral component over points of the insert, from the poses of a motion."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio

from tkamb.geometry.frames import Array, inverse


def step_twists(poses: Array) -> Array:
    """Return the spatial twist (f - 1, 6) of the screw that leads from each pose to the next.

    Linear part (m, velocity of the femoral material at the insert's origin times the step's
    duration), then angular part (rad), both in the insert frame:

        exp(twist) = pose_{k+1} pose_k^-1

    Args:
        poses: (f, 4, 4) pose_femoral_in_insert.
    """
    moves = poses[1:] @ inverse(poses[:-1])
    return np.array([pinocchio.log6(pinocchio.SE3(move)).vector for move in moves]).reshape(-1, 6)


def step_sliding(poses: Array, points: Array, normals: Array) -> Array:
    """Return how far the femoral surface slides over each point in each step, (f - 1, n, 3) m.

    Under a screw motion the material that passes through a fixed point x has the constant
    velocity v + omega × x, so that the step's path is exact for a translation and for a
    rotation of any size: an arc r·phi, no chord. What is along the insert's normal is no
    sliding and is taken off. Where the femur rolls, v + omega × x is zero.

    Args:
        poses: (f, 4, 4) pose_femoral_in_insert.
        points: (n, 3) m on the insert.
        normals: (n, 3) unit outward normals of the insert there.
    """
    twists = step_twists(poses)
    path = twists[:, None, :3] + np.cross(twists[:, None, 3:], points[None])
    along = np.einsum("snj,nj->sn", path, normals)
    return path - along[..., None] * normals


@dataclass(frozen=True, eq=False)
class SlidingHistory:
    """Pressure and sliding at the points of the insert in one cycle, step by step.

    Args:
        pressure: (s, n) Pa, mean of both ends of each step; zero: no contact.
        sliding: (s, n, 3) m, of the femoral surface over the point, in the tangent plane.
        normals: (n, 3) unit outward normals of the insert.
        passes: how often the steps are gone through in a cycle; 2 where the way back is the
            way out.
        seconds: (s,) duration of each step; None: all are equally long.
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
        """Return the history of frames (f,) whose maps (f, n) hold at poses (f, 4, 4).

        The pressure of a step is the mean of its two frames: sums over the cycle are the
        trapezoidal rule, of second order in the step.
        """
        between = 0.5 * (pressure[:-1] + pressure[1:])
        return cls(between, step_sliding(poses, points, normals), normals, passes, seconds)

    @cached_property
    def length(self) -> Array:
        """Path of each step, (s, n) m."""
        return np.linalg.norm(self.sliding, axis=2)

    @cached_property
    def work(self) -> Array:
        """Pressure times path, (s, n) N/m: frictional work per area at a friction of one."""
        return self.pressure * self.length

    @cached_property
    def total_work(self) -> Array:
        """The same summed over the cycle, (n,) N/m."""
        return self.passes * self.work.sum(axis=0)

    @cached_property
    def distance(self) -> Array:
        """Path over each point while it is in contact, (n,) m a cycle."""
        return self.passes * np.where(self.pressure > 0, self.length, 0.0).sum(axis=0)

    @cached_property
    def mean_pressure(self) -> Array:
        """Time-mean pressure over the whole cycle, (n,) Pa."""
        return np.average(self.pressure, axis=0, weights=self.seconds)

    @cached_property
    def cross_shear(self) -> Array:
        """Cross-shear ratio (n,), see `cross_shear_ratio`; zero where nothing slides."""
        return cross_shear_ratio(self.work, self.sliding, self.normals)


def cross_shear_ratio(work: Array, sliding: Array, normals: Array) -> Array:
    """Return the share of frictional work done across the principal direction, (n,), 0 to 0.5.

    A step's work w in the direction (cos t, sin t) of the tangent plane does w cos²(t - a) along
    and w sin²(t - a) across a direction a. Sums over the cycle are the quadratic forms of

        M = sum over steps of w d dᵀ,      d the unit direction of sliding

    so that the principal direction, which has the greatest work along it, is the eigenvector of
    the larger eigenvalue, and

        CS = lambda_min / (lambda_min + lambda_max)

    On a rectangular path of sides A <= B under constant pressure CS = A/(A + B), on a circle
    1/2, on a line 0.

    Args:
        work: (s, n) pressure times path.
        sliding: (s, n, 3) m in the tangent plane.
        normals: (n, 3) unit normals.

    References:
        Wang, Wear 248:38 (2001): molecules align with the principal direction of sliding, work
        across it tears them; Turell et al., Wear 259:984 (2005): rectangular paths, A/(A + B).
    """
    first, second = _tangents(normals)
    u = np.einsum("snj,nj->sn", sliding, first)
    v = np.einsum("snj,nj->sn", sliding, second)
    square = u**2 + v**2
    share = np.divide(work, square, out=np.zeros_like(work), where=square > 0)
    uu, vv, uv = ((share * a).sum(axis=0) for a in (u * u, v * v, u * v))
    total = uu + vv
    apart = np.hypot(uu - vv, 2.0 * uv)
    ratio = np.divide(total - apart, 2.0 * total, out=np.zeros_like(total), where=total > 0)
    return np.clip(ratio, 0.0, 0.5)


def _tangents(normals: Array) -> tuple[Array, Array]:
    """Return two unit vectors (n, 3) that span the plane across each normal."""
    axis = np.eye(3)[np.abs(normals).argmin(axis=1)]  # the axis farthest from the normal
    first = np.cross(normals, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)
