"""Where the patella touches the femoral component, and along which line it is pressed.

Everything is in the patellar joint's frame: the femur's, x anterior, y superior, z right;
the patella moves in it in the sagittal plane only (x, y, rotation about z).

A patella in its groove touches two facets, to the left and to the right of it. Each facet
has its own closest points (python-fcl), gap g and unit normal n out of the femur. How the
contact force is shared between them, lambda on the left and 1 - lambda on the right, follows
from a patella that may yield mediolaterally by c times the lateral part of that share:

    gap = min over 0 <= lambda <= 1 of  lambda g_l + (1 - lambda) g_r + (c/2) n_z²,
    n = lambda n_l + (1 - lambda) n_r

For c -> 0 this is the nearer facet alone; for c -> infinity both facets press with no net
lateral force. In between the line of action moves smoothly from frame to frame, where the
single closest point would jump across the groove. The sagittal part of n is the direction
of the patellofemoral force; its lateral part and tilting are not modelled.
"""

from dataclasses import dataclass

import fcl
import numpy as np
import trimesh
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.geometry.corner_normals import corner_normals, sharp_edges
from tkamb.geometry.frames import Array, pose
from tkamb.geometry.nearest import barycentric
from tkamb.geometry.surface import Surface

SKIN = 1e-3
"""m: the button is shrunk by this before distances are taken, which makes the gap smooth
through zero and valid down to -1 mm."""

LATERAL_YIELD = 0.01
"""m: c above, the patella's mediolateral travel if its contact force were purely lateral."""

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
        lateral: z component of the shared normal, 0 where the facets balance.
        at_edge: the femoral point lies on a sharp or open edge of the mesh.
    """

    gap: float
    point: Array
    normal: Array
    share_left: float
    lateral: float
    at_edge: bool


@dataclass(frozen=True, eq=False)
class _Facet:
    """The femoral component on one side of the groove."""

    collision: fcl.CollisionObject
    triangles: Array
    corner_normals: Array
    sharp: NDArray[np.bool_]


class PatellofemoralContact:
    """Closest points between button and femoral component.

    Args:
        femoral: femoral component in the patellar joint's frame; triangles share vertices.
        patellar: button in the patella's frame, x anterior: its joint side faces -x.
        ml: m, z of the patella's frame in the joint's frame: also where the groove is split.
        lateral_yield: m, c in the module's equation.

    Raises:
        InputError: the femoral component lies on one side of the patella only.
    """

    def __init__(
        self,
        femoral: Surface,
        patellar: Surface,
        ml: float = 0.0,
        lateral_yield: float = LATERAL_YIELD,
    ) -> None:
        self.ml, self.lateral_yield = ml, lateral_yield
        self._facets = [_facet(femoral, side) for side in _split(femoral, ml)]
        self._button = fcl.CollisionObject(_tree(_shrunk(patellar)), fcl.Transform())

    def pose(self, coordinates: Array) -> Array:
        """Return pose_patella_in_joint (4, 4) at (ap, si, rotation), m and rad."""
        ap, si, rotation = coordinates
        c, s = np.cos(rotation), np.sin(rotation)
        return pose([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], [ap, si, self.ml])

    def at(self, coordinates: Array) -> PatellarContact:
        """Return the contact at (ap, si, rotation), m and rad.

        A button deeper in than the skin is drawn out anteriorly until its closest points
        exist, and the gap is continued linearly from there: a bridge for the search only.
        """
        here = self.pose(np.asarray(coordinates, float))
        outward = here[:3, 0]
        for drawn in SKIN * np.concatenate([[0.0], np.geomspace(1.0, 60.0, 14)]):
            self._button.setTransform(fcl.Transform(here[:3, :3], here[:3, 3] + drawn * outward))
            found = [_closest(facet, self._button) for facet in self._facets]
            if all(f[0] > 0.0 for f in found):
                return self._shared(found, drawn * outward)
        return self._shared([(max(f[0], 1e-9), *f[1:]) for f in found], drawn * outward)

    def _shared(
        self, found: list[tuple[float, Array, Array, bool]], drawn: Array
    ) -> PatellarContact:
        gaps = np.array([f[0] - SKIN - f[2] @ drawn for f in found])
        points, normals = np.array([f[1] for f in found]), np.array([f[2] for f in found])
        left = _share_left(gaps, normals[:, 2], self.lateral_yield)
        weights = np.array([left, 1.0 - left])
        force = weights @ normals
        gap = weights @ gaps + 0.5 * self.lateral_yield * force[2] ** 2
        point = _on_line_of_action(weights, points, normals)
        sagittal = np.array([force[0], force[1], 0.0])
        edge = bool(found[0][3]) if left > 0.5 else bool(found[1][3])
        unit = sagittal / np.linalg.norm(sagittal)
        return PatellarContact(float(gap), point, unit, float(left), float(force[2]), edge)


def _share_left(gaps: Array, lateral: Array, lateral_yield: float) -> float:
    """Return the minimiser lambda of the module's equation."""
    difference, slope = gaps[0] - gaps[1], lateral[0] - lateral[1]
    if abs(slope) < 1e-6:
        return float(difference < 0.0)
    return float(np.clip(-(lateral[1] + difference / (lateral_yield * slope)) / slope, 0.0, 1.0))


def _on_line_of_action(weights: Array, points: Array, normals: Array) -> Array:
    """Return the mean point, moved in the sagittal plane onto the resultant's line."""
    forces = weights[:, None] * normals
    resultant, mean = forces.sum(axis=0)[:2], weights @ points
    arms = points - mean
    moment = (arms[:, 0] * forces[:, 1] - arms[:, 1] * forces[:, 0]).sum()
    shift = moment / (resultant @ resultant) * np.array([resultant[1], -resultant[0]])
    return mean + np.append(shift, 0.0)


def _split(femoral: Surface, ml: float) -> list[NDArray[np.int64]]:
    """Return the faces of either side; those that straddle the plane belong to both."""
    z = femoral.triangles[:, :, 2] - ml
    sides = [np.flatnonzero((side * z > 0.0).any(axis=1)) for side in (-1.0, 1.0)]
    if any(len(faces) == 0 for faces in sides):
        raise InputError(
            "the femoral component lies on one side of the patella only",
            femoral.name,
            "check the patella's ML position and the component's place on the femur",
        )
    return sides


def _facet(femoral: Surface, faces: NDArray[np.int64]) -> _Facet:
    part = Surface(femoral.vertices, femoral.faces[faces], femoral.name)
    return _Facet(
        fcl.CollisionObject(_tree(part), fcl.Transform()),
        femoral.triangles[faces],
        corner_normals(femoral)[faces],
        sharp_edges(femoral)[faces],
    )


def _shrunk(patellar: Surface) -> Surface:
    mesh = trimesh.Trimesh(patellar.vertices, patellar.faces, process=True, validate=False)
    return Surface(
        np.asarray(mesh.vertices - SKIN * mesh.vertex_normals),
        np.asarray(mesh.faces),
        patellar.name,
    )


def _tree(surface: Surface) -> fcl.BVHModel:
    tree = fcl.BVHModel()
    tree.beginModel(len(surface.faces), len(surface.vertices))
    tree.addSubModel(surface.vertices, surface.faces)
    tree.endModel()
    return tree


def _closest(facet: _Facet, button: fcl.CollisionObject) -> tuple[float, Array, Array, bool]:
    """Return distance, femoral point, unit normal out of the femur, and whether on an edge.

    The normal is interpolated from the corners' normals, which is one order smoother than
    the direction between the closest points of two faceted surfaces; on an edge that
    direction is taken, which is then the truth.
    """
    request, result = fcl.DistanceRequest(enable_nearest_points=True), fcl.DistanceResult()
    distance = fcl.distance(facet.collision, button, request, result)
    on_femur, on_button = (np.array(p, float) for p in result.nearest_points)
    weights = barycentric(facet.triangles[result.b1][None], on_femur[None])[0]
    edge = bool((weights[facet.sharp[result.b1]] < EDGE_MARGIN).any())
    normal = weights @ facet.corner_normals[result.b1]
    if edge and distance > 0.0:
        normal = on_button - on_femur
    return float(distance), on_femur, normal / np.linalg.norm(normal), edge
