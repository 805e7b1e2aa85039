"""What the femoral adjustment does to the forces of the shipped knee."""

import numpy as np

from scenes import write_scene
from tkamb import load_scene, simulate

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
    return (
        simulate(load_scene(path, {"contact.adjust": adjust, "motion.frames": 26}), frames=FRAMES)
        for adjust in (True, False)
    )


def split(results):
    return results["medial_force_N"] / (results["medial_force_N"] + results["lateral_force_N"])


def test_the_adjustment_leaves_the_shipped_total_alone(tmp_path):
    """The source: the total changes by less than 0.001 BW. Here: 1e-5, nothing is to be mended."""
    adjusted, recorded = with_and_without(wrong_scene(tmp_path, 0.0, 0.0))
    change = adjusted["force_total_BW"] - recorded["force_total_BW"]
    assert np.abs(change).max() < 0.001
    np.testing.assert_array_equal(adjusted["adjust_coronal_deg"], 0.0)
    np.testing.assert_allclose(split(adjusted), split(recorded), atol=1e-4)


def test_the_adjustment_mends_the_split_of_a_coronal_error(tmp_path):
    """0.4 deg and 0.4 mm of error: the contact moves, and the total with it by 0.5 %."""
    right = next(with_and_without(wrong_scene(tmp_path / "right", 0.0, 0.0)))
    adjusted, recorded = with_and_without(wrong_scene(tmp_path / "wrong", 0.4, 0.4))
    change = adjusted["force_total_BW"] - recorded["force_total_BW"]
    assert np.abs(change).max() < 0.02
    assert (np.abs(adjusted["adjust_coronal_deg"]) > 0.3).all()
    kept = adjusted["adjust_restored"] == 0
    error = [np.abs(split(results) - split(right))[kept].max() for results in (adjusted, recorded)]
    assert error[0] < 0.2 * error[1]
