"""Tables of a scene in SI: the unit is removed from the key and the number is converted."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.io.recordings import recordings
from tkamb.io.scene import measured, recording_tables, tables
from tkamb.io.scene.table import SceneTable
from tkamb.units import DEGREE, MILLIMETRE

SCALES = {"_mm": MILLIMETRE, "_deg": DEGREE, "_Hz": 1.0, "_s": 1.0, "_N": 1.0, "_kg": 1.0}
"""Unit at the end of a key -> its value in SI."""

CLASSES: dict[type[SceneTable], type] = {
    tables.PatientTable: recordings.Patient,
    recording_tables.MotionTable: recordings.MotionRecording,
    recording_tables.MarkersTable: recordings.MarkerSet,
    recording_tables.MarkerSegmentTable: recordings.MarkerSegment,
    recording_tables.TibiaTable: recordings.ShankRecording,
    recording_tables.JointCentreTable: recordings.JointCentre,
    recording_tables.GroundReactionTable: recordings.ForceRecording,
    measured.MeasuredTable: recordings.ForceMeasurement,
    measured.EmgTable: recordings.EmgRecording,
}

NAMES = {"neutral_mm": "neutral_translation", "neutral_deg": "neutral_rotation"}
"""Two keys that differ by their unit alone."""


def in_si(table: SceneTable) -> Any:
    """Return the SI object of a table, see `CLASSES`.

    Keys that the class does not have are left out.
    """
    kind = CLASSES[type(table)]
    names = {one.name for one in fields(kind)}
    values = {}
    for key, value in table:
        unit = next((unit for unit in SCALES if key.endswith(unit)), "")
        name = NAMES.get(key, key.removesuffix(unit))
        if name in names:
            values[name] = _value(value, SCALES.get(unit, 1.0))
    return kind(**values)


def _value(value: Any, scale: float) -> Any:
    """Return a key's value with its numbers scaled; three in a row are a vector."""
    if isinstance(value, SceneTable):
        return in_si(value)
    if isinstance(value, dict):
        return {name: _value(one, scale) for name, one in value.items()}
    if isinstance(value, tuple):
        if value and isinstance(value[0], SceneTable):
            return tuple(in_si(one) for one in value)
        return value if scale == 1.0 else np.array(value) * scale
    if value is None or scale == 1.0 or isinstance(value, str | Path):
        return value
    return value * scale
