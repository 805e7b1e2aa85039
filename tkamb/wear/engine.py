"""The one place where wear asks the contact: pressure maps of a cycle on an insert."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from tkamb.contact.materials import Material
from tkamb.contact.model import ContactModel
from tkamb.contact.pair import Bearing, ContactPair
from tkamb.contact.result import ContactStatus
from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.geometry.frames import pose as pose_of
from tkamb.geometry.surface import Surface
from tkamb.wear.force_control import RestingPoses
from tkamb.wear.motion import CycleMotion

GRID = (-0.012, -0.006, 0.0, 0.006, 0.012)
"""m along x where the search for the dwell position begins."""
GRID_ACROSS = 0.002
"""m along z, likewise."""
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
    """A contact model and all of a contact but the insert's shape.

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
        poses, failed, guess = motion.poses.copy(), {}, None
        drive = motion.drive
        resting = None if drive is None else RestingPoses(self.model, state, drive)
        for k, (pose, load) in enumerate(zip(motion.poses, motion.load, strict=True)):
            if load <= 0:
                continue
            if resting is not None:
                pose, why = resting.at(k, float(load), guess)
                if why:
                    failed[k] = why
                    continue
            result = self.model.press(state, float(load), pose, guess)
            if result.status is not ContactStatus.OK:
                failed[k] = "; ".join(result.flags) or result.status.value
                continue
            pressure[k], poses[k], guess = result.pressure, result.pose, result
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
            found = pair.first_touch_height(pose_of(rotation, [place[0], 0.0, place[1]]))
            return found if np.isfinite(found) else 1.0

        middle = self.femoral.moved(pose_of(rotation, [0.0] * 3)).bounds.mean(axis=0)
        # the grid is centred where the bounding boxes' middles meet, and where the origins do
        starts = [
            np.array([x, z]) - start
            for start in (np.zeros(2), middle[[0, 2]])
            for x in GRID
            for z in (-GRID_ACROSS, 0.0, GRID_ACROSS)
        ]
        heights = [height(start) for start in starts]
        best = starts[int(np.argmin(heights))]
        if min(heights) >= 1.0:
            raise InputError("lies over the insert nowhere", self.femoral.name, "check the axes")
        found = minimize(height, best, method="Nelder-Mead", options=SEARCH)
        return float(found.x[0]), float(found.x[1])
