"""Questions about a walking foot: every step is measured, and loads it alike."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from jw_gait import needs_jw
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.run.plausibility.ground import step_questions

WEIGHT, PEAK = 700.0, 750.0
TIME = np.arange(0.0, 2.4, 0.01)
STANCES = ((0.1, 0.7), (1.2, 1.8))
"""s: start and end of each stance of the foot."""
MODELS = Path(__file__).parents[1] / "models"


def walk(*gains, until=None, swing=4.0):
    """Return a case with the given gain of the force in each stance, and the ankle's speed."""
    upward, speed = np.zeros(len(TIME)), np.full(len(TIME), swing)
    for (begin, end), gain in zip(STANCES, gains, strict=True):
        here = (begin < TIME) & (end > TIME)
        upward[here] = gain * PEAK * np.sin(np.pi * (TIME[here] - begin) / (end - begin))
        speed[here] = 0.1
    kept = slice(None) if until is None else slice(0, int(np.searchsorted(TIME, until)))
    none = np.zeros(len(TIME))
    return SimpleNamespace(
        ground=SimpleNamespace(force=np.column_stack([none, upward, none])[kept]),
        tibia=SimpleNamespace(velocity=np.column_stack([speed, *5 * [none]])[kept]),
        motion=SimpleNamespace(time=TIME[kept]),
        body_weight=WEIGHT,
    )


def test_steps_that_are_all_measured_are_asked_nothing():
    assert list(step_questions(walk(1.0, 1.05))) == []
    assert list(step_questions(walk(1.0, 0.0, swing=0.2))) == []  # no walk: the leg is lifted


def test_a_step_beside_the_plates_is_asked_about_in_its_frames():
    (question,) = step_questions(walk(1.0, 0.0))
    assert "without a measured force" in question.text and question.flag
    assert {k for k in range(len(TIME)) if question.concerns(k)} == set(
        np.flatnonzero((TIME > 1.2) & (TIME < 1.8))
    )


def test_a_plate_with_half_the_gain_is_asked_about():
    (question,) = step_questions(walk(0.5, 1.0))
    assert "one step loads the foot with 375 N" in question.text and "gain" in question.text
    assert list(step_questions(walk(1.0, 0.5, until=1.3))) == []  # cut off on its way up


@needs_jw
@pytest.mark.parametrize(("plates", "asked"), [([2, 3], 0), ([3], 1), ([2], 1)])
def test_a_recorded_walk_without_one_of_its_plates_is_asked_about(plates, asked):
    changes = {"ground_reaction.plates": plates}
    case = load_case(load_scene(MODELS / "jw" / "ngait_og3.toml", changes))
    assert len(list(step_questions(case))) == asked
