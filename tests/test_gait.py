"""Foot strikes and toe-offs from a force plate; questions about steps without a measured force."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from jw_gait import needs_jw
from pendulum_leg import recorded_leg
from synthetic_run import make_run
from tkamb import simulate
from tkamb.cli import main
from tkamb.io.recordings.gait_cycle import cycle_percent, find_gait
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.run.plausibility.ground import step_questions
from tkamb.run.summary import _gait
from tkamb.show.axis import horizontal_axis
from tkamb.show.panels import panels
from tkamb.show.plots import Sheet

RATE_HZ = 1000.0


def vertical(time, stances, ramp_s=0.05, load_N=700.0):
    """Return a force that rises and falls linearly within each stance."""
    force = np.zeros_like(time)
    for on, off in stances:
        force = np.maximum(
            force, load_N * np.clip(np.minimum(time - on, off - time) / ramp_s, 0.0, 1.0)
        )
    return force


def test_gait_events_are_where_the_force_crosses_the_threshold():
    time = np.arange(0.0, 3.0, 1 / RATE_HZ)
    gait = find_gait(time, vertical(time, [(0.4, 1.05), (1.5, 2.15)]))
    late = 0.05 * 20.0 / 700.0  # s, time for the force to reach the threshold of 20 N
    np.testing.assert_allclose(gait.foot_strikes, [0.4 + late, 1.5 + late], atol=1e-9)
    np.testing.assert_allclose(gait.toe_offs, [1.05 - late, 2.15 - late], atol=1e-9)
    assert gait.cycle(0.3, 2.5) == pytest.approx((0.4 + late, 1.5 + late))


def test_toe_off_is_in_per_cent_of_its_cycle():
    """Both thresholds are crossed 0.05 s x 20/700 inside the stance; a stride takes 1.1 s."""
    time = np.arange(0.0, 3.0, 1 / RATE_HZ)
    gait = find_gait(time, vertical(time, [(0.4, 1.05), (1.5, 2.15)]))
    case = SimpleNamespace(
        gait_cycle_s=gait.cycle(0.3, 2.5),
        motion=SimpleNamespace(cycle_percent=None),
        ground=SimpleNamespace(gait=gait),
    )
    expected = 100.0 * (1.05 - 0.4 - 2 * 0.05 * 20.0 / 700.0) / 1.1
    assert _gait(case)["gait"]["toe_off_percent"] == pytest.approx([expected])


def test_a_recording_that_begins_on_the_plate_has_no_first_strike():
    time = np.arange(0.0, 2.0, 1 / RATE_HZ)
    gait = find_gait(time, vertical(time, [(-0.3, 0.5), (0.9, 3.0)]))
    assert len(gait.foot_strikes) == len(gait.toe_offs) == 1
    assert gait.foot_strikes[0] == pytest.approx(0.9, abs=2e-3)
    assert gait.spans()[0][0] == 0.0
    assert gait.cycle(0.0, 2.0) is None


def test_noise_causes_no_gait_event():
    time = np.arange(0.0, 2.0, 1 / RATE_HZ)
    force = vertical(time, [(0.5, 1.2)])
    force[300:310], force[800:805] = 60.0, 0.0
    gait = find_gait(time, force)
    assert len(gait.foot_strikes) == len(gait.toe_offs) == 1


def test_a_constant_force_has_no_gait_event():
    time = np.arange(0.0, 1.0, 1 / RATE_HZ)
    for load in (0.0, 500.0):
        gait = find_gait(time, np.full_like(time, load))
        assert not gait.foot_strikes + gait.toe_offs and gait.cycle(0.0, 1.0) is None


def test_per_cent_of_the_cycle_is_nan_outside_two_strikes():
    percent = cycle_percent(np.array([0.9, 1.0, 1.5, 2.0, 2.1]), (1.0, 2.0))
    np.testing.assert_allclose(percent, [np.nan, 0.0, 50.0, 100.0, np.nan])


@pytest.mark.parametrize(("axis", "to"), [("time", 0.66), ("cycle", 60.0)])
def test_the_stance_is_shaded(axis, to):
    run = make_run("gait", 21)
    run.columns["time_s"] = np.linspace(0.0, 1.1, 21)
    run.summary["cycle_percent_s"] = [0.0, 1.1]
    run.summary["gait"] = {"stance_s": [[-0.2, 0.66]], "toe_off_percent": [60.0]}
    figure = Sheet(run, horizontal_axis(run, axis)).draw(panels(run)[0])
    (shade,) = [patch for patch in figure.axes[0].patches if patch.get_gid() == "stance"]
    assert shade.get_x() == pytest.approx(0.0)
    assert shade.get_x() + shade.get_width() == pytest.approx(to)
    flexion = Sheet(run, horizontal_axis(run, "flexion")).draw(panels(run)[0])
    assert not [patch for patch in flexion.axes[0].patches if patch.get_gid() == "stance"]


def test_an_import_needs_a_cycle_on_the_plates_or_its_times(tmp_path, capsys):
    """A foot that never leaves its plate gives no cycle. The import then writes no scene."""
    arguments = recorded_leg(tmp_path)
    assert main([*arguments, "--cycle", "plates"]) == 2
    error = capsys.readouterr().err
    assert main([*arguments, "--cycle"]) == 2  # the default is "plates"
    assert capsys.readouterr().err == error
    assert "--cycle plates" in error and len(error.splitlines()) == 1
    out = Path(arguments[arguments.index("--out") + 1])
    assert not (out / "scene.toml").exists()
    assert main([*arguments, "--cycle", "0.5:1.5"]) == 0
    scene = load_scene(out / "scene.toml")
    assert scene.output.axis == "cycle" and scene.output.cycle_s == (0.5, 1.5)
    percent = simulate(scene)["cycle_percent"]
    assert np.nanmin(percent) >= 0.0 and np.nanmax(percent) <= 100.0


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
