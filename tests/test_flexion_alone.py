"""Recordings of flexion alone: equilibrium gives the other coordinates, or the scene is refused."""

from pathlib import Path

import numpy as np
import pytest

from tkamb.errors import InputError
from tkamb.geometry.condyles import LowestPoints
from tkamb.geometry.first_touch import FirstTouch
from tkamb.geometry.frames import knee_pose
from tkamb.io.recordings.tables import read_table
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.run.read_scene import recording_of

BEND = Path(__file__).parents[1] / "models" / "deep_knee_bend"
ALL = ["ap", "ml", "axial_rotation", "adduction"]
COARSE = {"contact.model": "foundation", "contact.resolution_mm": 2.0}
PATELLA = {"patella_ap", "patella_si", "patella_rotation"}
ROLES = {"time": "time_s", "flexion": "flexion_deg"} | {
    role: f"{role}_{'deg' if role.endswith('rotation') else 'mm'}" for role in PATELLA
}


def scene_of(folder, columns, released):
    """Return the shipped scene with a motion file of some of its columns."""
    table = read_table(BEND / "motion.csv", "csv")
    file = folder / "motion.csv"
    values = np.stack([table.columns[name] for name in columns], axis=1)
    np.savetxt(file, values, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")
    overrides = {"motion.file": str(file), "contact.released": released}
    overrides |= COARSE
    scene = load_scene(BEND / "scene.toml", overrides)
    column_names = {k: v for k, v in scene.motion.columns.items() if v in columns}
    return scene.model_copy(
        update={"motion": scene.motion.model_copy(update={"columns": column_names})}
    )


def test_flexion_alone_gives_the_equilibrium_of_the_whole_recording(tmp_path):
    alone = load_case(scene_of(tmp_path, list(ROLES.values()), ALL))
    full = load_case(load_scene(BEND / "scene.toml", {"contact.released": ALL} | COARSE))
    assert set(alone.motion.unrecorded) == {*ALL, "si"}
    recordings = [recording_of(case) for case in (alone, full)]
    for k in (30, 75):
        frames = [recording.frame(k) for recording in recordings]
        assert not any(frame.problem for frame in frames)
        places = [frame.equilibrium.coordinates for frame in frames]
        difference = np.abs(places[0] - places[1])
        assert difference[:3].max() < 2e-4, k
        assert np.degrees(difference[3:]).max() < 0.3, k


def test_the_initial_guess_touches_the_insert(tmp_path):
    case = load_case(scene_of(tmp_path, list(ROLES.values()), ALL))
    lowest = LowestPoints(case.femoral, case.split)
    touch = FirstTouch(case.femoral, case.insert)
    for place in case.motion.coordinates[::25]:
        middle = np.mean(lowest.at(knee_pose(place)), axis=0)
        assert abs(middle[0]) < 1e-5 and abs(middle[2]) < 1e-5
        assert abs(touch.travel(knee_pose(place))) < 1e-6


@pytest.mark.parametrize(
    ("columns", "released", "missing"),
    [
        (["time_s", "flexion_deg"], [], "adduction, axial_rotation|ap, si, ml"),
        (["time_s", "flexion_deg", "ap_mm", "si_mm", "ml_mm"], ["adduction"], "axial_rotation"),
        (["time_s", "adduction_deg"], ALL, "flexion"),
    ],
)
def test_a_coordinate_that_is_neither_recorded_nor_released_is_refused(
    tmp_path, columns, released, missing
):
    with pytest.raises(InputError, match=missing):
        load_case(scene_of(tmp_path, columns, released))
