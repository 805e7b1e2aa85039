"""The patella on docs/validation.md and docs/studies.md: stored numbers and their table."""

from pathlib import Path

import pytest

import tkamb
from released_patella import RELEASED
from scenes import write_scene
from tradeoff_blocks import with_block
from validation.patella import differences, stored, tradeoff


def test_the_block_agrees_with_the_stored_numbers():
    page = Path(__file__).parents[1] / "docs" / "studies.md"
    text = page.read_text(encoding="utf-8")
    assert text == with_block(text, tradeoff(), "patella")


def test_the_words_beside_the_table_agree_with_it():
    """At both ends the ratio lies above the published range; short retinacula double it."""
    start, end = (stored()["rows"][k]["ratio"] for k in (0, -1))
    assert 1.05 * 0.29 < start[0] < 1.15 * 0.29 and 1.8 < max(start) / start[0] < 2.2
    assert end[0] > 1.04


def test_a_stored_row_is_computed_again(tmp_path):
    """One frame alone, with the coarse start of a first frame, has the same equilibrium."""
    button = {"model": "foundation", "resolution_mm": 1.0}
    path = write_scene(tmp_path, contact__patellofemoral=button, patella=RELEASED)
    found = tkamb.simulate(path, frames=slice(50, 51))
    flexion = found["flexion_deg"][0]
    row = next(
        one for one in stored()["rows"] if one["flexion"] == pytest.approx(flexion, abs=1e-6)
    )
    assert found["patella_tilt_deg"][0] == pytest.approx(row["tilt"][0], abs=1e-4)
    assert found["patella_shift_mm"][0] == pytest.approx(row["shift"][0], abs=1e-4)
    assert found["button_area_mm2"][0] == pytest.approx(row["area"][0], rel=1e-3)
    ratio = found["button_force_N"][0] / found["quadriceps_N"][0]
    assert ratio == pytest.approx(row["ratio"][0], rel=1e-5)


def test_differences_are_ratios_in_a_frame():
    nothing = [float("nan")] * 3
    plane = {"seconds": [9.0, 1.0, 2.0], "peak": nothing, "area": nothing, "force": nothing}
    coarse = {"seconds": [9.0, 2.0, 6.0], "peak": [1.8, 1.0, 0.6]}
    finest = {"seconds": [9.0, 9.0, 9.0], "peak": [2.0, 2.0, 2.0]}
    for one in (coarse, finest):
        one["area"] = one["force"] = one["peak"]
    rows = differences({"plane": plane, "coarse": coarse, "finest": finest})
    assert rows[0]["peak"] is None and rows[0]["frames"] == 0
    assert rows[1]["ratio"] == 2.5 and rows[1]["ms"] == 4000.0
    assert rows[1]["peak"] == pytest.approx([-0.5, -0.7]) and rows[2]["force"] == [0.0, 0.0]
