"""What errors of skin markers do to shank and knee.

A marker sits off where its segment has it by an error that is the same in all frames. The rigid
fit of the segment's markers is then off by the pose that best carries their places to the places
with the errors: the reading `method = "segments"`. A chain's joints spread the same errors over
more segments.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import (
    KNEE_COORDINATES,
    MIRROR,
    Array,
    inverse,
    knee_coordinates,
    knee_pose,
)
from tkamb.inputs.markers import fit_seen
from tkamb.scene.case import Case
from tkamb.scene.recording_tables import MarkerSegmentTable
from tkamb.uncertainty.inputs import MARKED, Draw
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.inputs.tibia import BodyMotion


def displaced_by_markers(case: Case, draw: Draw) -> "tuple[BodyMotion | None, Array]":
    """Return the shank, and the knee coordinates (f, 6), with the markers' errors in them.

    Of the coordinates those change that are taken from the markers.

    Args:
        case: the case.
        draw: the errors of its inputs, `marker.<label>` among them.
    """
    markers, tibia, coordinates = case.scene.motion.markers, case.tibia, case.motion.coordinates
    if (
        markers is None
        or tibia is None
        or not any(one.name.startswith("marker.") for one in draw.inputs)
    ):
        return tibia, coordinates
    known = {one.name: one for one in markers.segment}
    left = case.scene.patient.side == "left"
    shank, thigh = (_misfit(known[name], draw, left) for name in MARKED)
    insert, knee = case.chain.insert_in_tibia, knee_pose(coordinates)
    there = inverse(shank @ insert) @ insert @ knee @ thigh
    change = knee_coordinates(there) - knee_coordinates(knee)
    moved = coordinates.copy()
    taken = [KNEE_COORDINATES.index(name) for name in markers.coordinates]
    moved[:, taken] += change[:, taken]
    return replace(tibia, pose=tibia.pose @ shank), moved


def _misfit(segment: MarkerSegmentTable, draw: Draw, left: bool) -> Array:
    """Return the pose (4, 4) of the fitted segment in the true one, as a right leg's."""
    points = np.array(list(segment.markers_mm.values())) * MILLIMETRE
    points = points @ MIRROR if left else points
    errors = np.array([draw.place(f"marker.{label}") for label in segment.markers_mm])
    weights = np.array([segment.weights.get(label, 1.0) for label in segment.markers_mm])
    poses, _ = fit_seen((points + errors)[None], points, weights, segment.name)
    return np.asarray(poses[0])
