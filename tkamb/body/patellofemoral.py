"""Where the patella touches the femoral component, and along which line it is pressed.

Everything is in the patellar joint's frame: the femur's, x anterior, y superior, z right;
the patella moves in it in the sagittal plane only (x, y, rotation about z).

The joint side of the button is sampled. Sample i has the signed distance d_i from the
femoral component, there the nearest point p_i and its normal n_i. The single closest point
of two faceted, nearly conforming surfaces jumps by centimetres from frame to frame; so the
contact is the mean over a thin patch, with weights w_i ~ exp(-d_i/tau), for the samples on
either side of the patella's middle:

    g = sum w_i d_i - tau,    p = sum w_i p_i,    n = sum w_i n_i

For a paraboloid of any curvature g is the distance of the closest points, exactly. A patella
in its groove touches on its left and on its right. How the force is shared, lambda on the
left and 1 - lambda on the right, follows from soft tissue that lets the patella shift by c
times the lateral force and tilt by d times the tilting moment, per unit contact force:

    gap = min over 0 <= lambda <= 1 of
          lambda g_l + (1 - lambda) g_r + (c/2) n_z² + (d/2) a²
    n_z = lambda n_lz + (1 - lambda) n_rz      a = lambda z_l + (1 - lambda) z_r

z measured from the patella's middle. The sagittal part of lambda n_l + (1 - lambda) n_r is
the direction of the patellofemoral force. Shift and tilt are estimated to first order and
reported, not carried out.
"""

import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import Array, pose, transform
from tkamb.geometry.normals import sharp_edges
from tkamb.geometry.surface import Surface

PATCH_DEPTH = 5e-5
"""m: tau above; a contact of relative radius R is averaged over about sqrt(R tau)."""

SAMPLE_SPACING = 1e-3
"""m: spacing of the samples of the button, in the patella's coronal plane."""

REACH = 20.0 * PATCH_DEPTH
"""m: samples farther than this behind the nearest one weigh nothing (exp(-20) = 2e-9)."""

COARSE = 60
"""Samples that a quick look takes."""

LATERAL_YIELD = 0.01
"""m: c above, the shift if the contact force were purely lateral."""

TILT_YIELD = 10.0
"""rad/m: d above, the tilt (5.7 deg) if the whole force acted 10 mm beside the middle."""

SIDEWAYS = 1e-9
"""Sagittal part of a unit normal below which there is none."""

EDGE_MARGIN = 0.02
"""Barycentric distance from a sharp edge within which a point lies on it."""


@dataclass(frozen=True, eq=False)
class PatellarContact:
    """The contact at one position of the patella, in the patellar joint's frame.

    Args:
        gap: m, positive when apart.
        point: (3,) m, on the line of action, at the height of the facets' contact points.
        normal: (3,) unit, in the sagittal plane, out of the femur into the patella.
        share_left: lambda, the share of the facet on the -z side.
        shift: m along z, by which soft tissue would let the patella yield; first order.
        tilt: rad about y, likewise.
        on_edge: share of the force on sharp or open edges of the femoral mesh.
    """

    gap: float
    point: Array
    normal: Array
    share_left: float
    shift: float
    tilt: float
    on_edge: float


class PatellofemoralContact:
    """Contact between button and femoral component, prepared for many positions.

    Distances of samples that cannot matter are carried over from the position before, with
    what the samples have moved since as a bound: this saves time and changes nothing, since
    samples beyond `REACH` have no weight.

    Args:
        femoral: femoral component in the patellar joint's frame; triangles share vertices.
        patellar: button in the patella's frame, x anterior: its joint side faces -x.
        ml: m, z of the patella's frame in the joint's frame.
        lateral_yield: m, c in the module's equation.
        tilt_yield: rad/m, d in the module's equation.

    Raises:
        InputError: the button has no surface that faces the femur on both sides.
    """

    def __init__(
        self,
        femoral: Surface,
        patellar: Surface,
        ml: float = 0.0,
        lateral_yield: float = LATERAL_YIELD,
        tilt_yield: float = TILT_YIELD,
    ) -> None:
        self.ml, self._yield = ml, np.array([lateral_yield, tilt_yield])
        self._nearest = femoral.nearest
        self._corner_normals, self._sharp = femoral.corner_normals, sharp_edges(femoral)
        self._samples = _joint_side(patellar)
        self._left: NDArray[np.bool_] = np.asarray(self._samples[:, 2] < 0.0)
        self._sides = (self._left, ~self._left)
        self._forget()

    def _forget(self) -> None:
        """Have no distance carried over."""
        count = len(self._samples)
        self._seen_at = np.full((count, 3), np.inf)
        self._distance = np.zeros(count)
        self._foot, self._normal = np.zeros((count, 3)), np.zeros((count, 3))
        self._on_edge = np.zeros(count)

    def unused(self) -> "PatellofemoralContact":
        """Return the same contact as it was before any position was looked at."""
        other = copy.copy(self)
        other._forget()
        return other

    def pose(self, coordinates: Array) -> Array:
        """Return pose_patella_in_joint (4, 4) at (ap, si, rotation), m and rad."""
        ap, si, rotation = coordinates
        c, s = np.cos(rotation), np.sin(rotation)
        return pose([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], [ap, si, self.ml])

    def at(self, coordinates: Array) -> PatellarContact:
        """Return the contact at (ap, si, rotation), m and rad.

        Raises:
            ComputationError: it pushes straight sideways, which no line in the plane can balance.
        """
        self._measure(transform(self.pose(np.asarray(coordinates, float)), self._samples))
        sides = [self._side(side) for side in self._sides]
        gaps, points, normals, edges = (np.array(part) for part in zip(*sides, strict=True))
        out_of_plane = np.stack([normals[:, 2], points[:, 2] - self.ml])
        left = _share_left(gaps, out_of_plane, self._yield)
        weights = np.array([left, 1.0 - left])
        force, sideways = weights @ normals, out_of_plane @ weights
        sagittal = np.array([force[0], force[1], 0.0])
        length = float(np.linalg.norm(sagittal))
        if length < SIDEWAYS:
            raise ComputationError("the femur pushes the patella straight sideways")
        shift, tilt = self._yield * sideways
        return PatellarContact(
            gap=float(weights @ gaps + 0.5 * self._yield @ sideways**2),
            point=_on_line_of_action(weights, points, normals),
            normal=sagittal / length,
            share_left=left,
            shift=float(shift),
            tilt=float(tilt),
            on_edge=float(weights @ edges),
        )

    def touches(self, coordinates: Array) -> bool:
        """Return whether a few of the samples lie in the femur: a quick look for searches."""
        few = self._samples[:: max(1, len(self._samples) // COARSE)]
        here = transform(self.pose(np.asarray(coordinates, float)), few)
        low, high = self._nearest.surface.bounds
        here = here[((here >= low) & (here <= high)).all(axis=1)]  # beside its box none is in it
        near = self._nearest.at(here)
        apart = np.einsum("ij,ij->i", here - near.points, near.normals)
        return bool((apart < 0.0).any())

    def _measure(self, here: Array) -> None:
        """Bring the distances up to date wherever they could matter.

        A sample that has moved by m since it was seen at distance d lies between d - m and d + m:
        what cannot come within `REACH` of its side's nearest keeps what was seen.
        """
        moved = np.linalg.norm(here - self._seen_at, axis=1)
        new = ~np.isfinite(moved)
        farthest = np.where(new, np.inf, self._distance + moved)
        nearest = np.where(new, -np.inf, self._distance - moved)
        reach = np.where(self._left, *(farthest[side].min() + REACH for side in self._sides))
        self._look(here, np.flatnonzero((moved > 0.0) & (nearest < reach)))

    def _look(self, here: Array, which: NDArray[np.int64]) -> None:
        if len(which) == 0:
            return
        near = self._nearest.at(here[which])
        weights = self._nearest.surface.barycentric(near.points, near.faces)
        on_edge = np.asarray((self._sharp[near.faces] & (weights < EDGE_MARGIN)).any(axis=1))
        smooth = np.einsum("ij,ijk->ik", weights, self._corner_normals[near.faces])
        outward = np.where(on_edge[:, None], near.normals, smooth)
        apart = here[which] - near.points
        sign = np.where(np.einsum("ij,ij->i", apart, outward) < 0.0, -1.0, 1.0)
        self._seen_at[which], self._foot[which] = here[which], near.points
        self._distance[which] = sign * near.distance
        self._normal[which] = outward / np.linalg.norm(outward, axis=1, keepdims=True)
        self._on_edge[which] = on_edge

    def _side(self, side: NDArray[np.bool_]) -> tuple[float, Array, Array, float]:
        """Return g, p, n and the share on edges of one side."""
        distance = self._distance[side]
        behind = distance - distance.min()
        weights = np.where(behind < REACH, np.exp(-behind / PATCH_DEPTH), 0.0)
        weights /= weights.sum()
        gap = float(weights @ distance) - PATCH_DEPTH
        edge = float(weights @ self._on_edge[side])
        return gap, weights @ self._foot[side], weights @ self._normal[side], edge


def _joint_side(patellar: Surface) -> Array:
    """Return samples (n, 3) of the surface that a view along the patella's +x shows."""
    low, high = patellar.bounds
    axes = [np.arange(low[k] + 0.5 * SAMPLE_SPACING, high[k], SAMPLE_SPACING) for k in (1, 2)]
    y, z = (grid.ravel() for grid in np.meshgrid(*axes, indexing="ij"))
    start = np.column_stack([np.full(len(y), low[0] - SAMPLE_SPACING), y, z])
    distance, _ = patellar.rays.first(start, np.array([1.0, 0.0, 0.0]))
    hit = np.isfinite(distance)
    samples = start[hit] + distance[hit, None] * np.array([1.0, 0.0, 0.0])
    if not ((samples[:, 2] < 0.0).any() and (samples[:, 2] >= 0.0).any()):
        raise InputError(
            "does not lie on both sides of the patella's sagittal plane",
            patellar.name,
            "check the mesh's unit, axes and position on the patella",
        )
    return samples


def _share_left(gaps: Array, out_of_plane: Array, yields: Array) -> float:
    """Return the minimiser lambda of the module's equation."""
    slope = out_of_plane[:, 0] - out_of_plane[:, 1]
    curvature = yields @ slope**2
    difference = gaps[0] - gaps[1]
    if curvature < 1e-12:
        return float(difference < 0.0)
    least = -(difference + (yields * slope) @ out_of_plane[:, 1]) / curvature
    return float(np.clip(least, 0.0, 1.0))


def _on_line_of_action(weights: Array, points: Array, normals: Array) -> Array:
    """Return the mean point, moved in the sagittal plane onto the resultant's line."""
    forces = weights[:, None] * normals
    resultant, mean = forces.sum(axis=0)[:2], weights @ points
    arms = points - mean
    moment = (arms[:, 0] * forces[:, 1] - arms[:, 1] * forces[:, 0]).sum()
    shift = moment / (resultant @ resultant) * np.array([resultant[1], -resultant[0]])
    return np.asarray(mean + np.append(shift, 0.0))
