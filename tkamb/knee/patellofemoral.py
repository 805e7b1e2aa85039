"""Contact of the patellar button with the femoral component, and line of action of its force.

Everything is in the patellar joint's frame, x anterior, y superior, z right, which is fixed to the
femur. The patella moves in the sagittal plane of this frame (x, y, rotation about z).

The joint side of the button is sampled. Sample i has the signed distance d_i from the femoral
component, with the nearest point p_i and the normal n_i there. The closest point of two faceted,
nearly conforming surfaces jumps by centimetres from frame to frame. So the contact is a weighted
mean over the samples of each side of the patella's middle, with weights w_i ~ exp(-d_i/tau):

    g = sum w_i d_i - tau,    p = sum w_i p_i,    n = sum w_i n_i

For a paraboloid of any curvature, g is exactly the distance of the closest points. A patella in its
groove touches on its left (-z) and on its right side. The left side has the share lambda of the
force. The share follows from soft tissue with which the patella shifts by c times the lateral force
and tilts by d times the tilting moment, per unit contact force:

    gap = min over 0 <= lambda <= 1 of
          lambda g_l + (1 - lambda) g_r + (c/2) n_z² + (d/2) a²
    n_z = lambda n_lz + (1 - lambda) n_rz      a = lambda z_l + (1 - lambda) z_r

with z from the patella's middle. The sagittal part of lambda n_l + (1 - lambda) n_r is the
direction of the patellofemoral force. Shift and tilt are reported as first-order estimates; the
patella itself stays in the sagittal plane.
"""

import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import ComputationError, InputError
from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.frames import Array, Index, pose, transform
from tkamb.geometry.surface import Surface, sharp_edges


@dataclass(frozen=True)
class PatellofemoralSettings:
    """Samples and weights of the patellofemoral contact, and its soft tissue."""

    patch_depth: float = 5e-5
    """m: tau of the module's equations. Chosen: a contact of relative radius R is averaged over
    about sqrt(R tau)."""
    sample_spacing: float = 1e-3
    """m: spacing of the button's samples in the patella's coronal plane. Chosen: about the facets
    of a mesh."""
    sample_range: float = 14.0 * patch_depth
    """m: a sample whose distance exceeds the least one by more has no weight. Chosen: its weight
    would be exp(-14) = 8e-7, and the gap of a patch of twenty samples jumps by 3e-11 m."""
    coarse_samples: int = 60
    """Number of samples of the quick check for touch. Chosen: enough for an initial guess."""
    lateral_compliance: float = 0.01
    """m: c of the module's equations, the shift under a purely lateral contact force. Chosen: soft
    enough to keep the search smooth."""
    tilt_compliance: float = 10.0
    """rad/m: d of the module's equations; a force 10 mm beside the middle tilts by 5.7 deg. Chosen:
    soft enough to keep the search smooth."""
    least_sagittal_part: float = 1e-9
    """1: sagittal part of a unit normal below which the normal has no sagittal direction. Chosen:
    above rounding."""


PATELLOFEMORAL = PatellofemoralSettings()


STRAIGHT = 1e-12
"""m: curvature of the gap over the share below which the nearer side carries all of the force."""

FIELDS = 11
"""Count of the numbers that describe the contact; see `_shared`."""

EDGE_MARGIN = 0.02
"""Barycentric distance from a sharp edge within which a point lies on it."""


@dataclass(frozen=True, eq=False)
class PatellarContact:
    """The contact at one position of the patella, in the patellar joint's frame.

    Args:
        gap: m, negative in penetration.
        point: (3,) m, point of the line of action next to the mean of both sides' points.
        normal: (3,) unit, in the sagittal plane, out of the femur into the patella.
        share_left: lambda, share of the force on the -z side.
        shift: m along z, first-order estimate of the patella's shift.
        tilt: rad about y, first-order estimate of the patella's tilt.
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

    The distance of a sample is computed again only if the sample can have a weight at the new
    position: the change of its distance is at most its displacement. This saves time without a
    change of the result.

    Args:
        femoral: femoral component in the patellar joint's frame, with shared vertices.
        patellar: button in the patella's frame; its joint side faces -x.
        ml: m, z of the patella's frame in the joint's frame.
        lateral_yield: m, c of the module's equation.
        tilt_yield: rad/m, d of the module's equation.

    Raises:
        InputError: the button does not lie on both sides of the sagittal plane.
    """

    def __init__(
        self,
        femoral: Surface,
        patellar: Surface,
        ml: float = 0.0,
        lateral_yield: float = PATELLOFEMORAL.lateral_compliance,
        tilt_yield: float = PATELLOFEMORAL.tilt_compliance,
    ) -> None:
        self.ml, self._yield = ml, np.array([lateral_yield, tilt_yield])
        self._nearest = femoral.nearest
        normals = femoral.corner_normals, femoral.vertex_normals
        self._facets = femoral.triangles, *normals, sharp_edges(femoral)
        self._samples = _joint_side(patellar)
        self._left: NDArray[np.bool_] = np.asarray(self._samples[:, 2] < 0.0)
        self._forget()

    def _forget(self) -> None:
        """Drop all stored distances."""
        count = len(self._samples)
        never, zeros = np.full((count, 3), np.inf), np.zeros(count)
        places = np.zeros((count, 3)), np.zeros((count, 3))
        # Of each sample: position at its last evaluation, distance, nearest point, normal, and
        # whether the nearest point is on an edge.
        self._seen = never, zeros, *places, np.zeros(count)

    def unused(self) -> "PatellofemoralContact":
        """Return the same contact without stored distances."""
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
            ComputationError: the force has no sagittal part.
        """
        contact = np.empty(FIELDS)
        length = _shared(self._sides_at(coordinates), self.ml, self._yield, contact)
        if length < PATELLOFEMORAL.least_sagittal_part:
            raise ComputationError("the femur pushes the patella straight sideways")
        gap, left_share, shift, tilt, on_edge = contact[:5].tolist()
        return PatellarContact(gap, contact[5:8], contact[8:], left_share, shift, tilt, on_edge)

    def touches(self, coordinates: Array) -> bool:
        """Say whether any of a few samples lies inside the femur, as a quick check."""
        few = self._samples[:: max(1, len(self._samples) // PATELLOFEMORAL.coarse_samples)]
        samples = transform(self.pose(np.asarray(coordinates, float)), few)
        low, high = self._nearest.surface.bounds
        # A sample outside the femur's box cannot lie inside the femur.
        samples = samples[((samples >= low) & (samples <= high)).all(axis=1)]
        near = self._nearest.at(samples)
        apart = np.einsum("ij,ij->i", samples - near.points, near.normals)
        return bool((apart < 0.0).any())

    def _sides_at(self, coordinates: Array) -> Array:
        """Return gap, point, normal and share on edges (2, 8), left and right."""
        samples = transform(self.pose(np.asarray(coordinates, float)), self._samples)
        seen_at, distance = self._seen[:2]
        which = _which_matter(samples, self._left, PATELLOFEMORAL.sample_range, seen_at, distance)
        if len(which):
            nearest = self._nearest.at(samples[which])
            _take(
                which,
                samples,
                nearest.distance,
                nearest.faces,
                nearest.weights,
                *self._facets,
                *self._seen,
            )
        sides = np.empty((2, 8))
        _mean_over_sides(
            self._left,
            PATELLOFEMORAL.patch_depth,
            PATELLOFEMORAL.sample_range,
            *self._seen[1:],
            sides,
        )
        return sides


@compiled_as_written
def _which_matter(
    samples: Array, on_left: NDArray[np.bool_], reach: float, seen_at: Array, distance: Array
) -> Index:
    """Return the samples whose distances must be computed again.

    A sample that has moved by m since its distance was d has a distance between d - m and d + m.
    These bounds show which samples cannot have a weight.

    Args:
        samples: (n, 3) m, present positions of the samples.
        on_left: (n,) whether a sample is on the -z side.
        reach: m, excess over the least distance beyond which a sample has no weight.
        seen_at: (n, 3) m, position of each sample at its last evaluation; inf: none.
        distance: (n,) m, signed distance at that position.
    """
    count, nearest = len(samples), np.full(2, np.inf)
    displacement, which, number = np.full(count, np.inf), np.empty(count, np.int64), 0
    for n in range(count):
        if seen_at[n, 0] < np.inf:
            displacement[n] = np.sqrt(np.sum((samples[n] - seen_at[n]) ** 2))
            side = 0 if on_left[n] else 1
            # Upper bound of the least distance of this side.
            nearest[side] = min(nearest[side], distance[n] + displacement[n])
    for n in range(count):
        # The lower bound of this sample's distance shows that it has no weight.
        beyond = distance[n] - displacement[n] >= nearest[0 if on_left[n] else 1] + reach
        if displacement[n] != 0.0 and not beyond:  # a NaN is computed again, too
            which[number] = n
            number += 1
    return which[:number]


@compiled_as_written
def _take(
    which: Index,
    samples: Array,
    apart: Array,
    faces: Index,
    weights: Array,
    triangles: Array,
    smooth_normals: Array,
    vertex_normals: Array,
    sharp: NDArray[np.bool_],
    seen_at: Array,
    distance: Array,
    foot: Array,
    normal: Array,
    on_edge: Array,
) -> None:
    """Store the distances, nearest points and normals of samples.

    Args:
        which: (m,) indices of the samples.
        samples: (n, 3) m, positions of all samples.
        apart: (m,) m, unsigned distances of the samples.
        faces: (m,) triangles of their nearest points.
        weights: (m, 3) barycentric coordinates of their nearest points.
        triangles: (k, 3, 3) m, triangles of the femoral component.
        smooth_normals: (k, 3, 3) unit normals at the corners, which differ across sharp edges.
        vertex_normals: (k, 3, 3) unit normals at the corners, means over each vertex.
        sharp: (k, 3) whether the edge opposite each corner is sharp or open.
        seen_at: (n, 3) m, output: positions of the samples.
        distance: (n,) m, output: signed distances.
        foot: (n, 3) m, output: nearest points.
        normal: (n, 3) output: unit normals at the nearest points.
        on_edge: (n,) output: 1 if the nearest point is on a sharp or open edge, else 0.
    """
    outward = np.empty(3)
    for m in range(len(which)):
        n, face, edge = which[m], faces[m], False
        for corner in range(3):
            edge |= sharp[face, corner] and weights[m, corner] < EDGE_MARGIN
        # Across a sharp edge the mean over the vertices turns without a jump.
        normals = vertex_normals[face] if edge else smooth_normals[face]
        along, length = 0.0, 0.0
        for k in range(3):
            foot[n, k], outward[k], seen_at[n, k] = 0.0, 0.0, samples[n, k]
            for corner in range(3):
                foot[n, k] += weights[m, corner] * triangles[face, corner, k]
                outward[k] += weights[m, corner] * normals[corner, k]
            along += (samples[n, k] - foot[n, k]) * outward[k]
            length += outward[k] ** 2
        for k in range(3):
            normal[n, k] = outward[k] / np.sqrt(length)
        # A sample behind the surface is inside the femur.
        distance[n] = -apart[m] if along < 0.0 else apart[m]
        on_edge[n] = 1.0 if edge else 0.0


@compiled_as_written
def _mean_over_sides(
    on_left: NDArray[np.bool_],
    depth: float,
    reach: float,
    distance: Array,
    foot: Array,
    normal: Array,
    on_edge: Array,
    means: Array,
) -> None:
    """Write g, p, n and the share on edges (2, 8), left and right.

    Args:
        on_left: (n,) as for `_which_matter`.
        depth: m, tau of the module's equation.
        reach: m, as for `_which_matter`.
        distance: (n,) m, as for `_take`.
        foot: (n, 3) m, as for `_take`.
        normal: (n, 3) as for `_take`.
        on_edge: (n,) as for `_take`.
        means: (2, 8) output.
    """
    for side in range(2):
        nearest, total = np.inf, 0.0
        for n in range(len(on_left)):
            if on_left[n] == (side == 0):
                nearest = min(nearest, distance[n])
        means[side] = 0.0
        for n in range(len(on_left)):
            behind = distance[n] - nearest
            if on_left[n] != (side == 0) or behind >= reach:
                continue
            # Boltzmann weights relative to the nearest sample, so that no exponential overflows.
            weight = np.exp(-behind / depth)
            total += weight
            means[side, 0] += weight * distance[n]
            means[side, 7] += weight * on_edge[n]
            for k in range(3):
                means[side, 1 + k] += weight * foot[n, k]
                means[side, 4 + k] += weight * normal[n, k]
        means[side] /= total
        # The weighted mean over a paraboloid exceeds its smallest distance by tau, which is
        # subtracted.
        means[side, 0] -= depth


@compiled_as_written
def _shared(sides: Array, middle: float, yields: Array, contact: Array) -> float:
    """Write the contact with the share of the module's equation; return the normal's sagittal part.

    Args:
        sides: (2, 8) gap, point, normal and share on edges, left and right.
        middle: m, z of the patella's middle.
        yields: (2,) c and d.
        contact: (`FIELDS`,) output: gap, share of the left, shift, tilt, share on edges,
            point (3,) and normal (3,) of the line of action in the sagittal plane.
    """
    # The gap is a parabola in the share of the left side; at its minimum, shift and tilt are in
    # equilibrium.
    curvature, slope = 0.0, sides[0, 0] - sides[1, 0]
    for k in range(2):
        at, offset = (6, 0.0) if k == 0 else (3, middle)
        change = sides[0, at] - sides[1, at]
        curvature += yields[k] * change * change
        slope += yields[k] * change * (sides[1, at] - offset)
    if curvature < STRAIGHT:
        left_share = 1.0 if sides[0, 0] < sides[1, 0] else 0.0
    else:
        # A side cannot pull, so that the share stays in [0, 1].
        left_share = min(max(-slope / curvature, 0.0), 1.0)
    mean = left_share * sides[0] + (1.0 - left_share) * sides[1]
    moment, length = 0.0, np.sqrt(mean[4] ** 2 + mean[5] ** 2)
    for side in range(2):
        part = left_share if side == 0 else 1.0 - left_share
        moment += (sides[side, 1] - mean[1]) * part * sides[side, 5]
        moment -= (sides[side, 2] - mean[2]) * part * sides[side, 4]
    # Lateral part of the normal, and the distance of the force from the middle.
    aside, lever = mean[6], mean[3] - middle
    contact[0] = mean[0] + 0.5 * (yields[0] * aside**2 + yields[1] * lever**2)
    contact[1], contact[2], contact[3], contact[4] = (
        left_share,
        yields[0] * aside,
        yields[1] * lever,
        mean[7],
    )
    # The mean point, moved in the sagittal plane onto the line of action of the resultant.
    contact[5] = mean[1] + moment / length**2 * mean[5]
    contact[6], contact[7] = mean[2] - moment / length**2 * mean[4], mean[3]
    contact[8], contact[9], contact[10] = mean[4] / length, mean[5] / length, 0.0
    return length


def _joint_side(patellar: Surface) -> Array:
    """Return samples (n, 3), m, of the surface that is seen along the patella's +x."""
    low, high = patellar.bounds
    axes = [
        np.arange(
            low[k] + 0.5 * PATELLOFEMORAL.sample_spacing, high[k], PATELLOFEMORAL.sample_spacing
        )
        for k in (1, 2)
    ]
    y, z = (grid.ravel() for grid in np.meshgrid(*axes, indexing="ij"))
    start = np.column_stack([np.full(len(y), low[0] - PATELLOFEMORAL.sample_spacing), y, z])
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
