"""The elastic foundation's probe: the columns near by, and their tangent.

A femoral displacement u at the point that a column meets, with femoral normal m there,
changes the gap along the insert's normal n by (m . u)/(m . n). With p'(d) the slope of the
layer's pressure, a column of area A adds to the stiffness of the wrench on the insert

    A p'(d)/(m . n)  [n; x cross n] [m; h cross m]^T

x the point on the insert, h the point met. The meshes' facets are taken as they are, so the
stiffness is the exact tangent wherever no ray crosses from facet to facet.
"""

import numpy as np

from tkamb.contact.foundation import (
    DEEPEST_STRAIN,
    THINNEST,
    FoundationState,
    Law,
    gaps_and_facets,
    layer_pressure,
    layer_slope,
)
from tkamb.contact.probe import CondyleWrench, ProbedContact
from tkamb.contact.summary import medial_points
from tkamb.geometry.frames import Array, transform

REACH = 1.5e-3
"""m; the columns nearer than this are looked at while the femur moves by less."""


class FoundationProbe:
    """See `tkamb.contact.probe.Probe`.

    Args:
        law: of the layer.
        state: what its `prepare` returned.
    """

    def __init__(self, law: Law, state: FoundationState) -> None:
        self._law, self._state = law, state
        self._corners = _corners(state.femoral_rays.surface.bounds)
        self._near, self._centre = state.bed, np.full((4, 4), np.nan)

    def at(self, pose: Array) -> ProbedContact:
        """Return the contact at a pose_femoral_in_insert (4, 4), with its stiffness."""
        pose = np.asarray(pose, float)
        if not self._covers(pose):
            gap = gaps_and_facets(self._state.bed, self._state.femoral_rays, pose)[0]
            self._near, self._centre = self._state.bed.part(gap < 2 * REACH), pose.copy()
        bed = self._near
        gap, femoral_normal = gaps_and_facets(bed, self._state.femoral_rays, pose)
        loaded = gap < 0
        if not loaded.any():
            return ProbedContact({}, tangent=True)
        bed, gap, femoral_normal = bed.part(loaded), gap[loaded], femoral_normal[loaded]
        thickness = np.maximum(bed.thickness, THINNEST)
        strain = -gap / thickness
        if not (strain < DEEPEST_STRAIN).all():
            return ProbedContact({}, known=False)
        material, law = self._state.pair.material, self._law
        force = layer_pressure(law, material, strain) * bed.area
        slope = layer_slope(law, material, strain) / thickness * bed.area
        push = screws(bed.points, bed.normals)
        along = np.einsum("ij,ij->i", femoral_normal, bed.normals)
        met = screws(bed.points + gap[:, None] * bed.normals, femoral_normal) / along[:, None]
        medial = medial_points(bed.points, pose, self._state.split)
        condyles = {}
        for side, own in (("medial", medial), ("lateral", ~medial)):
            if own.any():
                condyles[side] = CondyleWrench(
                    -force[own] @ push[own],
                    force[own] @ bed.points[own] / force[own].sum(),
                    (slope[own, None] * push[own]).T @ met[own],
                )
        return ProbedContact(condyles, tangent=True)

    def _covers(self, pose: Array) -> bool:
        """Return whether no femoral point has come nearer than the chosen columns reach."""
        if np.isnan(self._centre).any():
            return False
        moved = transform(pose, self._corners) - transform(self._centre, self._corners)
        return bool(np.linalg.norm(moved, axis=1).max() < REACH)


def screws(points: Array, directions: Array) -> Array:
    """Return direction and moment about the origin (n, 6) of lines through points (n, 3)."""
    return np.hstack([directions, np.cross(points, directions)])


def _corners(bounds: Array) -> Array:
    """Return the corners (8, 3) of a box."""
    return np.array([[x, y, z] for x in bounds[:, 0] for y in bounds[:, 1] for z in bounds[:, 2]])
