"""A femoral component: sagittal J-curves swept with a coronal groove-and-ridge profile.

A point of the articular surface is named by (phi, z): the normal of the sagittal profile and the
ML position. It lies `depth` below the profile along the inward normal, so that every condyle is a
torus piece: sagittal radius at the ridge, coronal radius across it. Where the two condyles have
different J-curves, the groove between them blends one into the other.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.studies.designs import solids
from tkamb.studies.designs.cam import Cam, joined
from tkamb.studies.designs.sagittal import SagittalProfile

Arcs = tuple[tuple[float, float, float], ...]

ROW_SPACING = (
    (-100.0, -15.0, 1.3),
    (-15.0, 12.0, 0.72),
    (12.0, 35.0, 0.64),
    (35.0, 135.0, 0.56),
    (135.0, 150.0, 0.9),
)
"""Spacing of the mesh's rows, mm, between normals in deg: fine where the insert is met."""


@dataclass(frozen=True)
class FemoralComponent:
    """A right femoral component; lengths mm, angles deg, z to the right (lateral).

    Args:
        medial_arcs: (from, to, radius) of the medial J-curve.
        lateral_arcs: of the lateral one; the same arcs for symmetric condyles.
        origin_phi: the centre of the medial arc that holds this normal is the origin.
        coronal_radius: across the ridges.
        ridge_half: ML distance of the ridges from the middle.
        ridge_half_at_flange_top: the same at the top of the flange.
        groove_radius: of the trochlear groove, tangent to both ridges.
        width_half: half the outer width.
        width_half_at_flange_top: the same at the top of the flange.
        taper_phi: ridges and edges widen from the first to the last of these normals.
        edge_fillet: radius of the rounded outer edge.
        notch_phi: the notch (or box) opens at the first and is fully wide from the second on.
        notch_half: half its width.
        notch_fillet: radius of its rounded edge.
        thickness: of the component.
        thickness_at_flange_top: the same at the top of the flange.
        blend_half: the groove within this distance blends unequal J-curves.
        cam: of a posterior-stabilised component; None for one without.
    """

    medial_arcs: Arcs
    lateral_arcs: Arcs
    origin_phi: float = 60.0
    coronal_radius: float = 22.0
    ridge_half: float = 23.0
    ridge_half_at_flange_top: float = 17.0
    groove_radius: float = 27.0
    width_half: float = 35.0
    width_half_at_flange_top: float = 25.0
    taper_phi: tuple[float, float] = (-100.0, -25.0)
    edge_fillet: float = 2.5
    notch_phi: tuple[float, float] = (50.0, 72.0)
    notch_half: float = 8.5
    notch_fillet: float = 1.5
    thickness: float = 9.0
    thickness_at_flange_top: float = 6.5
    blend_half: float = 11.0
    cam: Cam | None = None

    @cached_property
    def profile(self) -> SagittalProfile:
        """Medial J-curve, its posterior arc's centre at the origin."""
        start = SagittalProfile(self.medial_arcs)
        return start.moved(-start.centre_at(np.radians(self.origin_phi)))

    @cached_property
    def lateral_profile(self) -> SagittalProfile:
        """Lateral J-curve; it reaches as far distally and posteriorly as the medial one."""
        if self.lateral_arcs == self.medial_arcs:
            return self.profile
        start = SagittalProfile(self.lateral_arcs)
        ends = np.radians([90.0, 0.0])
        return start.moved(np.diag(self.profile.point(ends) - start.point(ends)))

    def ridge(self, phi: ArrayLike) -> Array:
        """Return the ML distance of the ridge (apex of the condyle) from the middle."""
        top = self.ridge_half_at_flange_top
        return np.asarray(top + (self.ridge_half - top) * self._taper(phi))

    def width(self, phi: ArrayLike) -> Array:
        """Return the ML distance of the outer edge from the middle."""
        top = self.width_half_at_flange_top
        return np.asarray(top + (self.width_half - top) * self._taper(phi))

    def notch(self, phi: ArrayLike) -> Array:
        """Return the ML distance of the notch's edge: an elliptic front, then parallel."""
        start, end = np.radians(self.notch_phi)
        s = np.clip((np.asarray(phi) - start) / (end - start), 0.0, 1.0)
        s = np.where(s < 1e-9, 0.0, s)
        return np.asarray(self.notch_half * np.sqrt(s * (2.0 - s)))

    def groove_depth(self, phi: ArrayLike) -> Array:
        """Return the depth of the groove's floor below the ridges; both arcs are tangent."""
        reach = self.groove_radius + self.coronal_radius
        return np.asarray(reach - np.sqrt(reach**2 - self.ridge(phi) ** 2))

    def depth(self, phi: ArrayLike, z: ArrayLike) -> Array:
        """Return the depth of the articular surface below the J-curve of the ridges."""
        u, apex, coronal = np.abs(z), self.ridge(phi), self.coronal_radius
        tangent = apex * self.groove_radius / (self.groove_radius + coronal)
        across = np.clip(u - apex, -coronal, coronal)
        convex = coronal - np.sqrt(coronal**2 - across**2)
        inside = np.minimum(u, self.groove_radius)
        concave = (
            self.groove_depth(phi) - self.groove_radius + np.sqrt(self.groove_radius**2 - inside**2)
        )
        edge = self.notch(phi)
        drop = rounded_edge(u - edge, self.notch_fillet) * edge / self.notch_half
        outer = rounded_edge(self.width(phi) - u, self.edge_fillet)
        return np.asarray(np.where(u < tangent, concave, convex) + drop + outer)

    def surface(self, phi: ArrayLike, z: ArrayLike) -> Array:
        """Return points (..., 3) of the articular surface in the femoral frame, mm."""
        phi, z = np.broadcast_arrays(phi, z)
        return self._below(phi, z, self.depth(phi, z))

    def groove(self, phi: ArrayLike) -> Array:
        """Return points (..., 2) of the groove's floor in the sagittal plane, mm."""
        at = np.asarray(phi, float)
        return np.asarray(self._below(at, np.zeros_like(at), self.groove_depth(at))[..., :2])

    def mesh(self) -> tuple[Array, NDArray[np.int64]]:
        """Return a closed triangulation (vertices mm, faces) in the femoral frame."""
        rows = self._rows()
        half = self._columns(rows)
        z = np.concatenate([-half[:, ::-1], half], axis=1)
        phi = np.broadcast_to(rows[:, None], z.shape)
        outer, inner = self.surface(phi, z), self._bone_side(phi, z)
        bridge = int(np.searchsorted(rows, np.radians(self.notch_phi[0]) + 1e-9)) - 1
        middle = z.shape[1] // 2
        columns = {0, *range(0, middle, 5), middle - 1, middle, *range(middle, 2 * middle, 5)}
        sections = sorted({*range(0, len(rows), 4), bridge, len(rows) - 1})
        return solids.close_sheets(
            outer, inner, sections, sorted({*columns, 2 * middle - 1}), bridge
        )

    def mesh_with_cam(self) -> tuple[Array, NDArray[np.int64]]:
        """Return the closed triangulation of `mesh` with the cam across its box.

        Raises:
            InputError: the component has no cam, or none that the walls of the box can hold.
        """
        if self.cam is None:
            raise InputError("the femoral component has no cam", "[cam]", "give its dimensions")
        return joined(self.cam, self.notch_half, *self.mesh())

    def _below(self, phi: Array, z: Array, depth: Array) -> Array:
        """Points (..., 3) at a depth below the J-curve that holds at z."""
        place = self.profile.point(phi, depth)
        if self.lateral_profile is not self.profile:
            s = np.clip(0.5 + 0.5 * np.asarray(z) / self.blend_half, 0.0, 1.0)
            lateral = (s * s * (3.0 - 2.0 * s))[..., None]
            place = (1.0 - lateral) * place + lateral * self.lateral_profile.point(phi, depth)
        return np.concatenate([place, np.asarray(z)[..., None]], axis=-1)

    def _bone_side(self, phi: Array, z: Array) -> Array:
        """Points (..., 3) of the surface towards the bone."""
        top = self.thickness_at_flange_top
        thickness = top + (self.thickness - top) * self._taper(phi)
        return self._below(phi, z, thickness)

    def _taper(self, phi: ArrayLike) -> Array:
        """0 at the top of the flange, 1 from the trochlea on, smooth (rad in)."""
        start, end = np.radians(self.taper_phi)
        s = np.clip((np.asarray(phi) - start) / (end - start), 0.0, 1.0)
        return np.asarray(s * s * (3.0 - 2.0 * s))

    def _columns(self, phi: Array) -> Array:
        """ML stations (rows, columns) of the right half, from the notch's edge outwards."""
        apex, outer, inner = (edge(phi)[:, None] for edge in (self.ridge, self.width, self.notch))
        rest = outer - self.edge_fillet
        near, far = apex - 9.0, apex + 0.8 * (rest - apex)
        turn = np.sin(np.radians(np.linspace(0.0, 90.0, 5)))[1:]
        return np.concatenate(
            [
                inner + (near - inner) * np.linspace(0.0, 1.0, 13)[:-1],
                near + (far - near) * np.linspace(0.0, 1.0, 24)[:-1],
                far + (rest - far) * np.linspace(0.0, 1.0, 3),
                rest + self.edge_fillet * turn,
            ],
            axis=1,
        )

    def _rows(self) -> Array:
        """Normals of the rows: fine where the insert is met, and across the notch's front."""
        start, end = np.radians(self.notch_phi)
        front = start + (end - start) * (1.0 - np.cos(np.radians(np.linspace(0.0, 30.0, 5))))
        rows = self.profile.nodes(ROW_SPACING)
        apart = np.abs(rows[:, None] - front).min(axis=1) > np.radians(0.3)
        return np.sort(np.concatenate([rows[apart], front]))


def rounded_edge(distance: ArrayLike, radius: ArrayLike) -> Array:
    """Return the drop of a rounded edge at `distance` from it; both mm."""
    inside = np.clip(np.asarray(radius) - distance, 0.0, radius)
    return np.asarray(radius - np.sqrt(np.asarray(radius) ** 2 - inside**2))
