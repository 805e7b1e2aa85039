"""Questions about a walking foot: steps without a measured force, and steps of unequal loads."""

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
    """Return a case with a gain of the force in each stance, and the ankle's speed in swing."""
    upward, speed = np.zeros(len(TIME)), np.full(len(TIME), swing)
    for (begin, end), gain in zip(STANCES, gains, strict=True):
        stance = (begin < TIME) & (end > TIME)
        upward[stance] = gain * PEAK * np.sin(np.pi * (TIME[stance] - begin) / (end - begin))
        speed[stance] = 0.1
    recorded = slice(None) if until is None else slice(0, int(np.searchsorted(TIME, until)))
    none = np.zeros(len(TIME))
    return SimpleNamespace(
        ground=SimpleNamespace(force=np.column_stack([none, upward, none])[recorded]),
        tibia=SimpleNamespace(velocity=np.column_stack([speed, *5 * [none]])[recorded]),
        motion=SimpleNamespace(time=TIME[recorded]),
        body_weight=WEIGHT,
    )


def test_measured_steps_raise_no_question():
    assert list(step_questions(walk(1.0, 1.05))) == []
    assert list(step_questions(walk(1.0, 0.0, swing=0.2))) == []  # The leg is lifted, not walking.


def test_a_step_beside_the_plates_raises_a_question_about_its_frames():
    (question,) = step_questions(walk(1.0, 0.0))
    assert "without a measured force" in question.text and question.flag
    assert {k for k in range(len(TIME)) if question.concerns(k)} == set(
        np.flatnonzero((TIME > 1.2) & (TIME < 1.8))
    )


def test_a_plate_with_half_the_gain_is_asked_about():
    (question,) = step_questions(walk(0.5, 1.0))
    assert "one step loads the foot with 375 N" in question.text and "gain" in question.text
    assert list(step_questions(walk(1.0, 0.5, until=1.3))) == []  # The second step is incomplete.


@needs_jw
@pytest.mark.parametrize(("plates", "asked"), [([2, 3], 0), ([3], 1), ([2], 1)])
def test_a_recorded_walk_without_one_of_its_plates_is_asked_about(plates, asked):
    changes = {"ground_reaction.plates": plates}
    case = load_case(load_scene(MODELS / "jw" / "ngait_og3.toml", changes))
    assert len(list(step_questions(case))) == asked
