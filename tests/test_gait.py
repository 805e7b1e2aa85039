"""Foot strikes, toe-offs and the gait cycle from a force plate."""

from pathlib import Path

import numpy as np
import pytest

from pendulum_leg import recorded_leg
from synthetic_run import make_run
from tkamb import load_scene, simulate
from tkamb.cli import main
from tkamb.io.recordings.gait_cycle import cycle_percent, find_gait
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
