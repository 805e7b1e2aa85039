"""Contact for wear: pressure maps of a cycle, and their pressure at the insert's vertices."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.sparse import csr_array
from scipy.spatial import Delaunay

from tkamb.contact.materials import Material
from tkamb.contact.model import ContactModel
from tkamb.contact.pair import Bearing, ContactPair
from tkamb.contact.result import ContactStatus
from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.geometry.frames import pose as pose_of
from tkamb.geometry.surface import Surface
from tkamb.studies.wear.motion import CycleMotion
from tkamb.studies.wear.simulator import RestingPoses

GRID = (-0.012, -0.006, 0.0, 0.006, 0.012)
"""m along x where the search for the dwell position begins."""


@dataclass(frozen=True)
class WearGridSettings:
    """Grid on which wear is summed."""

    spacing_z: float = 0.002
    """m; spacing along z (medial to lateral). Chosen: a scar is several times as wide."""


WEAR_GRID = WearGridSettings()

SEARCH = {"xatol": 1e-5, "fatol": 1e-9, "maxfev": 120}
"""The search ends within 10 µm."""


@dataclass(frozen=True, eq=False)
class CycleMaps:
    """Pressure maps of a cycle.

    Args:
        points: (m, 3) m, map points on the insert.
        triangles: (k, 3) between them.
        pressure: (f, m) Pa.
        poses: (f, 4, 4) at which the maps hold; the given ones where nothing is loaded.
        failed: frame -> why its contact, or its equilibrium, was not found.
    """

    points: Array
    triangles: NDArray[np.int64]
    pressure: Array
    poses: Array
    failed: dict[int, str]


@dataclass(frozen=True, eq=False)
class ContactEngine:
    """A contact model with femoral component and material; the insert's shape is an argument.

    Args:
        model: any contact model.
        femoral: rigid femoral component, in the femoral frame.
        material: of the insert.
        bearing: fixed or mobile.
    """

    model: ContactModel
    femoral: Surface
    material: Material
    bearing: Bearing = "fixed"

    def maps(self, insert: Surface, motion: CycleMotion) -> CycleMaps:
        """Press the loads of a motion into an insert, frame by frame.

        The poses of a driven motion are found on this insert first.
        """
        pair = ContactPair(self.femoral, insert, self.material, self.bearing)
        state = self.model.prepare(pair)
        pressure = np.zeros((len(motion), len(state.points)))
        poses, failed, start = motion.poses.copy(), {}, None
        drive = motion.drive
        resting = None if drive is None else RestingPoses(self.model, state, drive)
        for k, (pose, load) in enumerate(zip(motion.poses, motion.load, strict=True)):
            if load <= 0:
                continue
            if resting is not None:
                pose, why = resting.at(k, float(load), start)
                if why:
                    failed[k] = why
                    continue
            result, end = self.model.press_from(state, float(load), pose, start)
            if result.status is not ContactStatus.OK:
                failed[k] = "; ".join(result.flags) or result.status.value
                continue
            pressure[k], poses[k], start = result.pressure, result.pose, end
        return CycleMaps(state.points, state.triangles, pressure, poses, failed)

    def dwell(self, insert: Surface, rotation: Array) -> tuple[float, float]:
        """Return x and z (m) at which the femoral component lies lowest on an insert.

        The height of first touch is lowered from the lowest place of a coarse grid (simplex
        search). A simulator counts AP and ML from there.

        Args:
            insert: in the insert frame.
            rotation: (3, 3) of the femoral component.

        Raises:
            InputError: it lies over the insert nowhere.
        """
        pair = ContactPair(self.femoral, insert, self.material, self.bearing)

        def height(place: Array) -> float:
            result = pair.first_touch_height(pose_of(rotation, [place[0], 0.0, place[1]]))
            return result if np.isfinite(result) else 1.0

        middle = self.femoral.moved(pose_of(rotation, [0.0] * 3)).bounds.mean(axis=0)
        # the grid is centred where the bounding boxes' middles meet, and where the origins do
        starts = [
            np.array([x, z]) - start
            for start in (np.zeros(2), middle[[0, 2]])
            for x in GRID
            for z in (-WEAR_GRID.spacing_z, 0.0, WEAR_GRID.spacing_z)
        ]
        heights = [height(start) for start in starts]
        best = starts[int(np.argmin(heights))]
        if min(heights) >= 1.0:
            raise InputError("lies nowhere over the insert", self.femoral.name, "check the axes")
        result = minimize(height, best, method="Nelder-Mead", options=SEARCH)
        return float(result.x[0]), float(result.x[1])


def interpolation(map_points: Array, points: Array) -> csr_array:
    """Return weights (n, m) that interpolate values at map points (m, 3) to points (n, 3).

    Both are seen from above: linear on the Delaunay triangles of the map points' x and z, zero
    outside their hull. Second order in the map's spacing.
    """
    flat = Delaunay(map_points[:, [0, 2]])
    places = points[:, [0, 2]]
    simplex = flat.find_simplex(places)
    inside = np.flatnonzero(simplex >= 0)
    affine = flat.transform[simplex[inside]]
    two = np.einsum("nij,nj->ni", affine[:, :2], places[inside] - affine[:, 2])
    weights = np.column_stack([two, 1.0 - two.sum(axis=1)])
    weights = np.nan_to_num(np.clip(weights, 0.0, 1.0))  # NaN: a triangle without area
    columns = flat.simplices[simplex[inside]]
    rows = np.repeat(inside, 3)
    shape = (len(points), len(map_points))
    return csr_array((weights.ravel(), (rows, columns.ravel())), shape=shape)


def carried(pressure: Array, projected: Array, load: Array) -> tuple[Array, float]:
    """Scale maps (f, n) so that each carries its load, and return the largest change.

    Args:
        pressure: (f, n) Pa.
        projected: (n,) m², the area of each point seen from above.
        load: (f,) N along -y.
    """
    force = pressure @ projected
    scale = np.divide(load, force, out=np.ones_like(force), where=(force > 0) & (load > 0))
    return pressure * scale[:, None], float(np.abs(scale - 1.0).max(initial=0.0))
