"""Contact of the patellar button with the femoral component, and line of action of its force.

All positions are in the patellar joint's frame, x anterior, y superior, z right, fixed to the
femur. The patella moves in its sagittal plane (x, y, rotation about z).

Sample i of the button's articular side has the signed distance d_i from the femoral component, the
nearest point p_i and the normal n_i there. The closest point of two faceted, nearly conforming
surfaces jumps by centimetres from frame to frame. The contact of the left (-z) and of the right
side of the patella is therefore a weighted mean over its samples, with weights w_i ~ exp(-d_i/tau):

    g = sum w_i d_i - tau,    p = sum w_i p_i,    n = sum w_i n_i

For a paraboloid of any curvature, g is exactly the distance of the closest points. In its groove a
patella touches on both sides. Soft tissue decides the share lambda of the left one: per unit
contact force, the patella shifts by c times the lateral force and tilts by d times the tilting
moment:

    gap = min over 0 <= lambda <= 1 of
          lambda g_l + (1 - lambda) g_r + (c/2) n_z² + (d/2) a²
    n_z = lambda n_lz + (1 - lambda) n_rz      a = lambda z_l + (1 - lambda) z_r

where z is measured from the patella's middle. The sagittal part of n is the direction of the force.
Shift and tilt are first-order estimates: the computed patella stays in the sagittal plane.
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
    """m: tau of the module's equations. A contact of relative radius R is averaged over a radius of
    about sqrt(R tau). Larger: smoother, less local."""
    sample_spacing: float = 1e-3
    """m: spacing of the button's samples in the patella's coronal plane. Chosen because the facets
    of a mesh have about this size."""
    sample_range: float = 14.0 * patch_depth
    """m: excess over the smallest distance above which a sample has no weight. Chosen because the
    weight at this excess is exp(-14) = 8e-7: the gap of a patch of twenty samples jumps by 3e-11 m
    when a sample loses its weight."""
    coarse_samples: int = 60
    """Samples of the quick check for touch. Not studied."""
    lateral_compliance: float = 0.01
    """m: c of the module's equations, the shift under a purely lateral contact force. Chosen soft
    enough for a smooth search."""
    tilt_compliance: float = 10.0
    """rad/m: d of the module's equations. A force 10 mm beside the middle tilts by 5.7 deg. Chosen
    soft enough for a smooth search."""
    least_sagittal_part: float = 1e-9
    """1: sagittal part of a unit normal below which the normal has no sagittal direction. Chosen
    because it is above rounding errors."""


PATELLOFEMORAL = PatellofemoralSettings()


STRAIGHT = 1e-12
"""m: second derivative of the gap by lambda below which the nearer side has the whole force."""

FIELDS = 11
"""Number of values that describe the contact, see `_contact_of_sides`."""

EDGE_MARGIN = 0.02
"""1: barycentric distance from a sharp edge below which a point counts as a point of the edge."""


@dataclass(frozen=True, eq=False)
class PatellarContact:
    """The contact at one position, in the patellar joint's frame.

    Args:
        gap: gap, negative in penetration, m.
        point: point of the line of action that is nearest to the mean contact point, (3,), m.
        normal: unit normal from femur to patella, in the sagittal plane, (3,).
        share_left: lambda, share of the force on the -z side.
        shift: first-order estimate along z, m; `tilt`: about y, rad.
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
    """Contact between button and femoral component.

    The distance of a sample is computed again only if it can have a weight; the result does not
    change.

    Args:
        femoral: surface in the patellar joint's frame, with shared vertices.
        patellar: surface of the button in the patella's frame; its articular side faces -x.
        ml: z of the patella's frame in the joint's frame, m.
        lateral_yield: c of the module's equations, m.
        tilt_yield: d of the module's equations, rad/m.
    """

    def __init__(
        self,
        femoral: Surface,
        patellar: Surface,
        ml: float = 0.0,
        lateral_yield: float = PATELLOFEMORAL.lateral_compliance,
        tilt_yield: float = PATELLOFEMORAL.tilt_compliance,
    ) -> None:
        self.ml, self._compliances = ml, np.array([lateral_yield, tilt_yield])
        self._nearest = femoral.nearest
        normals = femoral.corner_normals, femoral.vertex_normals
        self._facets = femoral.triangles, *normals, sharp_edges(femoral)
        self._samples = _joint_side(patellar)
        self._left: NDArray[np.bool_] = np.asarray(self._samples[:, 2] < 0.0)
        self._clear_samples()

    def _clear_samples(self) -> None:
        count = len(self._samples)
        no_position, zeros = np.full((count, 3), np.inf), np.zeros(count)
        vectors = np.zeros((count, 3)), np.zeros((count, 3))
        # For each sample: position at the last evaluation, distance, nearest point, normal, and
        # whether the nearest point is on a sharp or open edge.
        self._stored = no_position, zeros, *vectors, np.zeros(count)

    def unused(self) -> "PatellofemoralContact":
        """Return the same contact without stored distances."""
        other = copy.copy(self)
        other._clear_samples()
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
        length = _contact_of_sides(self._sides_at(coordinates), self.ml, self._compliances, contact)
        if length < PATELLOFEMORAL.least_sagittal_part:
            raise ComputationError("the femur pushes the patella straight sideways")
        gap, left_share, shift, tilt, on_edge = contact[:5].tolist()
        return PatellarContact(gap, contact[5:8], contact[8:], left_share, shift, tilt, on_edge)

    def touches(self, coordinates: Array) -> bool:
        """Return whether any of a few samples lies inside the femur."""
        subset = self._samples[:: max(1, len(self._samples) // PATELLOFEMORAL.coarse_samples)]
        samples = transform(self.pose(np.asarray(coordinates, float)), subset)
        low, high = self._nearest.surface.bounds
        # A sample outside the femur's box cannot lie inside the femur.
        samples = samples[((samples >= low) & (samples <= high)).all(axis=1)]
        nearest = self._nearest.at(samples)
        heights = np.einsum("ij,ij->i", samples - nearest.points, nearest.normals)
        return bool((heights < 0.0).any())

    def _sides_at(self, coordinates: Array) -> Array:
        """Return gap, point, normal and share on edges, left and right (2, 8)."""
        samples = transform(self.pose(np.asarray(coordinates, float)), self._samples)
        last_position, distance = self._stored[:2]
        indices = _samples_to_update(
            samples, self._left, PATELLOFEMORAL.sample_range, last_position, distance
        )
        if len(indices):
            nearest = self._nearest.at(samples[indices])
            _store_samples(
                indices,
                samples,
                nearest.distance,
                nearest.faces,
                nearest.weights,
                *self._facets,
                *self._stored,
            )
        sides = np.empty((2, 8))
        _mean_over_sides(
            self._left,
            PATELLOFEMORAL.patch_depth,
            PATELLOFEMORAL.sample_range,
            *self._stored[1:],
            sides,
        )
        return sides


@compiled_as_written
def _samples_to_update(
    samples: Array,
    on_left: NDArray[np.bool_],
    sample_range: float,
    last_position: Array,
    distance: Array,
) -> Index:
    """Return the samples whose distances must be computed again.

    With the displacement m since its last evaluation a distance d is now between d - m and d + m,
    which excludes samples without weight.

    Args:
        samples: present positions of the samples, (n, 3), m.
        last_position: position of each sample at its last evaluation, (n, 3), m; inf: none.
        distance: signed distance at that position, (n,), m.
    """
    count, nearest = len(samples), np.full(2, np.inf)
    displacement, indices, number = np.full(count, np.inf), np.empty(count, np.int64), 0
    for n in range(count):
        if last_position[n, 0] < np.inf:
            displacement[n] = np.sqrt(np.sum((samples[n] - last_position[n]) ** 2))
            side = 0 if on_left[n] else 1
            # Upper bound of the smallest distance on this side.
            nearest[side] = min(nearest[side], distance[n] + displacement[n])
    for n in range(count):
        # Even the lower bound of the distance of an excluded sample is too large for a weight.
        excluded = distance[n] - displacement[n] >= nearest[0 if on_left[n] else 1] + sample_range
        if displacement[n] != 0.0 and not excluded:  # true for NaN, too
            indices[number] = n
            number += 1
    return indices[:number]


@compiled_as_written
def _store_samples(
    indices: Index,
    samples: Array,
    unsigned: Array,
    faces: Index,
    weights: Array,
    triangles: Array,
    smooth_normals: Array,
    vertex_normals: Array,
    sharp: NDArray[np.bool_],
    last_position: Array,
    distance: Array,
    nearest_point: Array,
    normal: Array,
    on_edge: Array,
) -> None:
    """Store the distances, nearest points and normals of m of the n samples.

    Args:
        indices: indices of the samples, (m,).
        samples: positions of all samples, (n, 3), m.
        unsigned: their unsigned distances, (m,), m, like `faces` and barycentric `weights`.
        smooth_normals: unit normals at the corners, (k, 3, 3). They jump at sharp edges.
        vertex_normals: the same as means over each vertex, (k, 3, 3).
        sharp: whether the edge opposite each corner is sharp or open, (k, 3).
        last_position: output like all following, see `_samples_to_update`.
        on_edge: 1 if the nearest point is on a sharp or open edge, else 0, (n,).
    """
    outward = np.empty(3)
    for m in range(len(indices)):
        n, face, edge = indices[m], faces[m], False
        for corner in range(3):
            edge |= sharp[face, corner] and weights[m, corner] < EDGE_MARGIN
        # Vertex normals do not jump across a sharp edge.
        normals = vertex_normals[face] if edge else smooth_normals[face]
        height, length = 0.0, 0.0
        for k in range(3):
            nearest_point[n, k], outward[k], last_position[n, k] = 0.0, 0.0, samples[n, k]
            for corner in range(3):
                nearest_point[n, k] += weights[m, corner] * triangles[face, corner, k]
                outward[k] += weights[m, corner] * normals[corner, k]
            height += (samples[n, k] - nearest_point[n, k]) * outward[k]
            length += outward[k] ** 2
        for k in range(3):
            normal[n, k] = outward[k] / np.sqrt(length)
        # A sample behind the surface is inside the femur: its distance is negative.
        distance[n] = -unsigned[m] if height < 0.0 else unsigned[m]
        on_edge[n] = 1.0 if edge else 0.0


@compiled_as_written
def _mean_over_sides(
    on_left: NDArray[np.bool_],
    depth: float,
    sample_range: float,
    distance: Array,
    nearest_point: Array,
    normal: Array,
    on_edge: Array,
    means: Array,
) -> None:
    """Compute g, p, n and the share on edges, left and right, into `means` (2, 8).

    `depth` is tau; `on_edge` (n,) is 1 at a nearest point on a sharp or open edge, else 0.
    """
    for side in range(2):
        nearest, total = np.inf, 0.0
        for n in range(len(on_left)):
            if on_left[n] == (side == 0):
                nearest = min(nearest, distance[n])
        means[side] = 0.0
        for n in range(len(on_left)):
            excess = distance[n] - nearest
            if on_left[n] != (side == 0) or excess >= sample_range:
                continue
            # Boltzmann weights relative to the nearest sample, so that no exponential overflows.
            weight = np.exp(-excess / depth)
            total += weight
            means[side, 0] += weight * distance[n]
            means[side, 7] += weight * on_edge[n]
            for k in range(3):
                means[side, 1 + k] += weight * nearest_point[n, k]
                means[side, 4 + k] += weight * normal[n, k]
        means[side] /= total
        # The weighted mean over a paraboloid exceeds its smallest distance by tau.
        means[side, 0] -= depth


@compiled_as_written
def _contact_of_sides(sides: Array, middle: float, compliances: Array, contact: Array) -> float:
    """Compute the contact by the module's equations, and return the normal's sagittal part.

    Args:
        sides: gap, point, normal and share on edges of the left and the right side, (2, 8).
        middle: z of the patella's middle, m.
        compliances: c (m) and d (rad/m).
        contact: output: gap, share of the left, shift, tilt, share on edges, point (3,) and normal
            (3,) of the line of action in the sagittal plane, (`FIELDS`,).
    """
    # The gap is a parabola in the share of the left side. At its minimum, shift and tilt are in
    # equilibrium.
    curvature, slope = 0.0, sides[0, 0] - sides[1, 0]
    for k in range(2):
        component, offset = (6, 0.0) if k == 0 else (3, middle)
        change = sides[0, component] - sides[1, component]
        curvature += compliances[k] * change * change
        slope += compliances[k] * change * (sides[1, component] - offset)
    if curvature < STRAIGHT:
        left_share = 1.0 if sides[0, 0] < sides[1, 0] else 0.0
    else:
        # A side cannot pull: the share stays in [0, 1].
        left_share = min(max(-slope / curvature, 0.0), 1.0)
    mean = left_share * sides[0] + (1.0 - left_share) * sides[1]
    moment, length = 0.0, np.sqrt(mean[4] ** 2 + mean[5] ** 2)
    for side in range(2):
        side_share = left_share if side == 0 else 1.0 - left_share
        moment += (sides[side, 1] - mean[1]) * side_share * sides[side, 5]
        moment -= (sides[side, 2] - mean[2]) * side_share * sides[side, 4]
    # Lateral part of the normal, and lever arm of the force about the middle.
    lateral, lever = mean[6], mean[3] - middle
    contact[0] = mean[0] + 0.5 * (compliances[0] * lateral**2 + compliances[1] * lever**2)
    contact[1], contact[2], contact[3], contact[4] = (
        left_share,
        compliances[0] * lateral,
        compliances[1] * lever,
        mean[7],
    )
    # Projection of the mean point onto the line of action, in the sagittal plane.
    contact[5] = mean[1] + moment / length**2 * mean[5]
    contact[6], contact[7] = mean[2] - moment / length**2 * mean[4], mean[3]
    contact[8], contact[9], contact[10] = mean[4] / length, mean[5] / length, 0.0
    return length


def _joint_side(patellar: Surface) -> Array:
    """Return samples (n, 3), m, by rays along the patella's +x."""
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
