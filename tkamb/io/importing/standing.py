"""Marker positions calibrated by a standing trial."""

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from tkamb.geometry.frames import MIRROR, Array, inverse, mirrored_pose, transform
from tkamb.io.importing.markers import ModelSegment, facing, segments_of
from tkamb.io.importing.scene_text import SceneText
from tkamb.io.recordings.inverse_kinematics import LegChain
from tkamb.io.recordings.marker_motion import both_fits, leg_segments, neutral_coordinates
from tkamb.io.recordings.markers import matched_labels, plain_label
from tkamb.io.recordings.recording_tables import MarkersTable
from tkamb.io.recordings.tables import Table, read_table, with_unit
from tkamb.io.scene import Scene


def with_static_markers(
    scene: SceneText, static: Path, segments: list[ModelSegment], length_unit: str | None = None
) -> tuple[SceneText, list[str]]:
    """Return the scene with its markers where they sit in a standing trial, and lines on it.

    `length_unit` is the trial's, where its own word is not understood.
    """
    assert scene.markers is not None
    stated = Scene.model_validate(tomllib.loads(scene.text())).motion.markers
    assert stated is not None
    recorded = with_unit(read_table(static), length_unit)
    own = facing(segments_of(recorded, segments), recorded).axes
    stated = stated.model_copy(update={"laboratory_axes": own})
    side: Literal["right", "left"] = "left" if scene.side == "left" else "right"
    insert = scene.links.insert_in_tibia
    if side == "left":
        insert = mirrored_pose(insert)
    places = calibrated_markers(stated, recorded, side, insert)
    changed_segments, farthest = [], 0.0
    for segment in segments:
        by_label = {plain_label(k): v for k, v in places[segment.name].items()}
        points = {k: by_label.get(plain_label(k), v) for k, v in segment.points.items()}
        shifts = [np.linalg.norm(points[k] - v) for k, v in segment.points.items()]
        farthest = max(farthest, float(np.max(shifts)))
        changed_segments.append(replace(segment, points=points))
    markers = replace(scene.markers, segments=tuple(changed_segments))
    line = (
        f"markers' places are those of the standing trial {static.name}, at most "
        f"{farthest * 1e3:.1f} mm from the model's"
    )
    notices = [f"notice: {static.name}: {notice}" for notice in recorded.notices]
    return replace(scene, markers=markers), [line, *notices]


def calibrated_markers(
    table: MarkersTable,
    recorded: Table,
    side: Literal["right", "left"],
    pose_insert_in_tibia: Array,
) -> dict[str, dict[str, Array]]:
    """Return where the markers sit on a subject who stands: segment -> marker -> (3,) m.

    The chain is fitted to the standing trial with the markers as the table has them; each
    marker's mean position in its fitted segment is its calibrated one. So the chain decides the
    pose of the bones, and the markers follow.

    Args:
        table: markers and joints; those that the trial does not hold are left as they are.
        recorded: the standing trial.
        side: of the leg.
        pose_insert_in_tibia: (4, 4), of the (mirrored) patient.

    Raises:
        InputError: the trial cannot be read, or its markers do not fit.
    """
    labels = [column[:-2] for column in recorded.columns if column.endswith("_x")]
    points = [
        own.model_copy(
            update={
                "markers_mm": {
                    k: v for k, v in own.markers_mm.items() if matched_labels([k], labels)
                }
            }
        )
        for own in table.segment
    ]
    markers = table.model_copy(update={"segment": tuple(points)})
    segments, measured = leg_segments(markers, recorded, None, side)
    chain = LegChain(segments, pose_insert_in_tibia, markers.knee == "free")
    neutral = neutral_coordinates(markers, side)
    _, whole = both_fits(chain, segments, measured, neutral, recorded)
    mirror = MIRROR if side == "left" else np.eye(3)
    result = {}
    for name, poses in chain.poses(whole.state).items():
        own_axes = np.nanmean(transform(inverse(poses), measured[name]), axis=0) @ mirror
        result[name] = dict(zip(chain.segments[name].labels, own_axes, strict=True))
    return result
