"""Effect of the femoral adjustment on the forces of the shipped knee."""

import numpy as np
import pytest

from scenes import write_scene
from tkamb import load_scene, simulate
from tkamb.io.scene.case import load_case
from tkamb.run.read_scene import recording_of

FRAMES = slice(3, 26, 10)


def wrong_scene(folder, degrees, raised_mm):
    """Write the shipped bend with a coronal and a vertical error in every frame."""
    path = write_scene(folder)
    file = path.parent / "motion.csv"
    header, *_ = file.read_text(encoding="utf-8").split("\n", 1)
    rows = np.loadtxt(file, delimiter=",", skiprows=1)
    names = header.split(",")
    rows[:, names.index("adduction_deg")] += degrees
    rows[:, names.index("si_mm")] += raised_mm
    np.savetxt(file, rows, "%.9g", ",", header=header, comments="")
    return path


def with_and_without(path):
    """Yield the results with the adjustment, then those without."""
    return (
        simulate(load_scene(path, {"contact.adjust": adjust, "motion.frames": 26}), frames=FRAMES)
        for adjust in (True, False)
    )


def split(results):
    """Return the medial share of the condylar forces by deformation."""
    return results["medial_force_N"] / (results["medial_force_N"] + results["lateral_force_N"])


def test_the_adjustment_leaves_the_shipped_total_alone(tmp_path):
    """Sharma (2008): the total changes by less than 0.001 BW."""
    adjusted, recorded = with_and_without(wrong_scene(tmp_path, 0.0, 0.0))
    change = adjusted["force_total_BW"] - recorded["force_total_BW"]
    assert np.abs(change).max() < 0.001
    np.testing.assert_array_equal(adjusted["adjust_coronal_deg"], 0.0)
    np.testing.assert_allclose(split(adjusted), split(recorded), atol=1e-4)


@pytest.mark.parametrize("degrees", [0.35, pytest.param(-0.35, marks=pytest.mark.slow)])
def test_the_adjustment_corrects_the_split_of_a_coronal_error(tmp_path, degrees):
    """With errors of 0.35 deg and 0.3 mm the total changes by 0.006 BW."""
    reference = next(with_and_without(wrong_scene(tmp_path / "right", 0.0, 0.0)))
    adjusted, recorded = with_and_without(wrong_scene(tmp_path / "wrong", degrees, 0.3))
    change = adjusted["force_total_BW"] - recorded["force_total_BW"]
    assert 1e-6 < np.abs(change).max() < 0.01
    np.testing.assert_allclose(adjusted["adjust_force_change_BW"], change, rtol=1e-9)
    share = adjusted["medial_share_equilibrium"] - recorded["medial_share_equilibrium"]
    np.testing.assert_allclose(adjusted["adjust_share_change"], share, rtol=1e-9)
    assert set(adjusted.status) == {"ok"}
    assert any("contradicts" in status for status in recorded.status)
    assert (np.abs(adjusted["adjust_coronal_deg"]) > 0.3).all()
    np.testing.assert_array_equal(adjusted["adjust_restored"], 0)
    error = [np.abs(split(results) - split(reference)).max() for results in (adjusted, recorded)]
    assert error[0] < 0.2 * error[1]


def test_a_total_that_depends_on_the_adjustment_is_flagged(tmp_path):
    """A condyle that is 0.6 mm too high lifts off when the other one touches."""
    path = wrong_scene(tmp_path, 0.9, -0.2)
    adjusted, recorded = with_and_without(path)
    change = adjusted["force_total_BW"] - recorded["force_total_BW"]
    np.testing.assert_allclose(adjusted["adjust_force_change_BW"], change, rtol=1e-9)
    assert (np.abs(change) > 0.01).any()
    for status, frame_change in zip(adjusted.status, change, strict=True):
        flagged = "femoral adjustment changes the total" in status
        assert flagged == (abs(frame_change) > 0.01)


def test_a_restored_frame_has_its_contact_points_at_the_recorded_rotation(tmp_path):
    path = wrong_scene(tmp_path, 0.3, 0.0)
    changes = {"contact.adjust": True, "contact.adjust_restore_when": "either"}
    case = load_case(load_scene(path, changes | {"motion.frames": 26}))
    recording = recording_of(case)
    restored = 0
    for k in (12, 23):
        frame = recording.frame(k)
        if not frame.adjustment.restored:
            continue
        restored += 1
        closest = recording.knee._query.at(frame.adjustment.pose)
        for name, point in frame.geometry.condyles.items():
            np.testing.assert_array_equal(point.point, getattr(closest, name).centre)
        np.testing.assert_array_equal(frame.contact.pose[:3, :3], recording.poses[k][:3, :3])
    assert restored
