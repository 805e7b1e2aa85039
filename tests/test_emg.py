"""EMG: envelopes, guidance of the static optimisation, agreement with activations."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import quad
from scipy.signal import butter, sosfiltfilt

from recordings import write_c3d
from shared_trials import STRENGTHS, two_flexors
from tkamb.errors import InputError
from tkamb.io.recordings.measured import Envelopes, envelope, load_envelopes
from tkamb.io.recordings.recording_tables import EmgTable
from tkamb.run.muscles.sharing import KKT_TOLERANCE, EmgGuide
from tkamb.run.recorded import compare_emg, fitted_normalisation

RATE = 1200.0
TIME = np.arange(int(4 * RATE)) / RATE
INSIDE = slice(600, -600)


def test_the_envelope_of_a_sine_is_its_rectified_mean():
    signal = 0.3 + 2.0 * np.sin(2 * np.pi * 97.3 * TIME)
    for high_pass in (20.0, "none"):
        result = envelope(signal, RATE, 6.0, high_pass)[INSIDE]
        np.testing.assert_allclose(result, 2 * 2.0 / np.pi, rtol=5e-3)


def test_the_envelope_has_no_phase_and_half_the_amplitude_at_the_cutoff():
    """The amplitude of a carrier at 150 Hz oscillates at the cut-off of the low-pass filter."""
    swing = 1 + 0.5 * np.sin(2 * np.pi * 5.0 * TIME)
    result = envelope(swing * np.sin(2 * np.pi * 151.7 * TIME), RATE, 5.0, 30.0)[INSIDE]
    expected = 2 / np.pi * (1 + 0.25 * np.sin(2 * np.pi * 5.0 * TIME[INSIDE]))
    np.testing.assert_allclose(result, expected, atol=0.01)


@pytest.mark.parametrize("high_pass", [20.0, "none"])
def test_the_envelope_is_that_of_filters_run_forwards_and_backwards(high_pass):
    signal = np.random.default_rng(3).normal(size=len(TIME)) * (1.2 + np.sin(5.0 * TIME))
    result, expected = envelope(signal, RATE, 6.0, high_pass), signal - signal.mean()
    if high_pass != "none":
        expected = sosfiltfilt(butter(2, high_pass, "highpass", fs=RATE, output="sos"), expected)
    expected = sosfiltfilt(butter(2, 6.0, fs=RATE, output="sos"), np.abs(expected))
    middle = slice(1500, -1500)
    np.testing.assert_allclose(result[middle], expected[middle], atol=1e-6 * expected.max())


def test_the_ends_of_an_envelope_have_the_mean_of_its_interior():
    """A reflection about the last sample would keep the value of this sample."""
    ends = [
        envelope(np.random.default_rng(k).normal(size=len(TIME)), RATE, 6.0, "none")[[0, -1]]
        for k in range(40)
    ]
    assert np.mean(ends) == pytest.approx(np.sqrt(2 / np.pi), rel=0.05)
    assert np.std(ends) < 0.2


def test_the_high_pass_filter_removes_slow_movement():
    slow = 3.0 * np.sin(2 * np.pi * 1.5 * TIME)
    assert envelope(slow, RATE, 6.0, 30.0)[INSIDE].max() < 0.01
    mean, _ = quad(lambda phase: 3.0 * abs(np.sin(phase)) / np.pi, 0, np.pi)
    assert envelope(slow, RATE, 6.0, "none")[INSIDE].mean() == pytest.approx(mean, rel=0.1)


@pytest.mark.parametrize(
    ("signal", "cutoff", "words"),
    [
        (np.full(500, np.nan), 6.0, "gap"),
        (np.ones(5000), 700.0, "700 Hz is not below half of 1200 Hz"),
        (np.ones(100), 6.0, "shorter than a period of the cut-off 6 Hz"),
    ],
)
def test_signals_without_an_envelope_are_refused(signal, cutoff, words):
    with pytest.raises(InputError, match=words):
        envelope(signal, RATE, cutoff, "none")


def table(file, **changes):
    """Return [muscles.emg] of a file with changed keys."""
    keys = {"channels": {"VL": ("vaslat",)}, "high_pass_Hz": 20.0, "cutoff_Hz": 6.0}
    return EmgTable(**({"file": file} | keys | changes))


def burst(centre):
    """Return a signal at 97.3 Hz with a maximum of its amplitude at a time, s."""
    return np.exp(-(((TIME - centre) / 0.2) ** 2)) * np.sin(2 * np.pi * 97.3 * TIME)


def test_channels_of_a_c3d_have_its_times_and_a_maximum_of_one(tmp_path):
    markers = {"heel": np.ones((400, 3))}
    path = write_c3d(
        tmp_path / "a.c3d", markers, first_frame=50, ratio=12, analog={"VL": 3e-4 * burst(1.5)}
    )
    result = load_envelopes(table(path, offset_s=0.04), TIME)
    values = result.values["VL"]
    assert values.max() == pytest.approx(1.0)
    assert result.time[values.argmax()] == pytest.approx(0.5 + 0.04 + 1.5, abs=0.01)
    assert np.isnan(result.at("vaslat", np.array([0.5, 4.6]))).all()
    normalised = load_envelopes(table(path, normalised_by={"VL": 3e-4}), TIME)
    assert normalised.values["VL"].max() < 2 / np.pi


def test_emg_is_read_from_a_csv_table(tmp_path):
    path = tmp_path / "emg.csv"
    rows = [f"{t:.6f},{v:.9f}," for t, v in zip(TIME, burst(2.0), strict=True)]
    path.write_text("\n".join(["clock,VL,", *rows]).replace("VL,", "VL"), encoding="utf-8")
    result = load_envelopes(table(path, time="clock"), TIME)
    assert result.time[result.values["VL"].argmax()] == pytest.approx(2.0, abs=0.01)
    with pytest.raises(
        InputError, match=r"from 9 to 12.9992 s, but the motion lasts from 0 to .*offset_s"
    ):
        load_envelopes(table(path, time="clock", offset_s=9.0), TIME)
    with pytest.raises(InputError, match="no column 'VM'"):
        load_envelopes(table(path, time="clock", channels={"VM": ("vasmed",)}), TIME)


@pytest.mark.parametrize("level", [0.0, 0.3, -1e-4])
@pytest.mark.parametrize("high_pass", [20.0, "none"])
def test_a_constant_channel_is_no_signal(tmp_path, level, high_pass):
    """The rounding error of 0.3 minus its mean must not be normalised to 1."""
    path = tmp_path / "flat.csv"
    path.write_text("\n".join(["time,VL", *(f"{t:.6f},{level}" for t in TIME)]), encoding="utf-8")
    with pytest.raises(InputError, match="'VL' holds no signal"):
        load_envelopes(table(path, high_pass_Hz=high_pass), TIME)


@pytest.mark.parametrize(
    "changes",
    [
        {"use": "target"},
        {"use": "bounds", "weight": 1.0},
        {"weight": 1.0},
        {"channels": {"VL": ("vaslat",), "VM": ("vaslat",)}},
        {"channels": {"VL": ()}},
        {"normalised_by": {"VM": 1.0}},
    ],
)
def test_tables_that_contradict_themselves_are_refused(tmp_path, changes):
    with pytest.raises(ValidationError):
        table(tmp_path, **changes)


WEIGHT, ENVELOPE, MOMENT = 3.0, 0.4, 70.0
ARMS = np.array([0.0, 0.05, 0.04])


def sharing(guide, lowest=0.0):
    """Return the problem of two flexors that balance 70 N·m without a reserve."""
    problems = two_flexors(1, reserve=0.0, least=lowest).problems
    arms = np.zeros((1, 3, 1))
    arms[0, :, 0] = ARMS
    return replace(problems, moment=np.full((1, 1), MOMENT), arms=arms, guide=guide)


def test_a_target_has_the_optimum_of_the_closed_form():
    """Minimum of Σ a² + W (a_2 - e)² with d.a = M: a_2 = (W e - λ d_2)/(1 + W), a_3 = -λ d_3."""
    guide = EmgGuide(np.array([[np.nan, ENVELOPE, np.nan]]), "target", WEIGHT)
    activation, _, residual, status = sharing(guide).solved(0)
    d = (ARMS * STRENGTHS)[1:]
    stiff, pull = np.array([1 + WEIGHT, 1.0]), np.array([WEIGHT * ENVELOPE, 0.0])
    multiplier = (MOMENT - d @ (pull / stiff)) / (d @ (d / stiff))
    np.testing.assert_allclose(activation[1:], (pull + multiplier * d) / stiff, rtol=1e-9)
    assert status == "ok"
    assert residual < KKT_TOLERANCE


def test_bounds_limit_the_activation_to_the_width_about_the_envelope():
    guide = EmgGuide(np.array([[np.nan, 0.4, np.nan]]), "bounds", 0.05)
    activation, _, residual, status = sharing(guide).solved(0)
    assert activation[1] == pytest.approx(0.45)  # without EMG it is 0.61
    assert activation[2] == pytest.approx((MOMENT - 0.45 * 0.05 * 1800) / (0.04 * 1200))
    assert status == "ok"
    assert residual < KKT_TOLERANCE


def test_bounds_of_the_envelope_are_within_those_of_all_muscles():
    guide = EmgGuide(np.array([[np.nan, 1.7, 0.0]]), "bounds", 0.2)
    problem = guide.applied(sharing(None, lowest=0.05).frame(0), 0)
    np.testing.assert_allclose(problem.lowest, [0.05, 1.0, 0.05])
    np.testing.assert_allclose(problem.highest, [1.0, 1.0, 0.2])


def test_each_frame_of_a_knee_has_its_own_envelope():
    trial = two_flexors(2, reserve=0.0, least=0.0)
    values = np.array([[np.nan, 0.5, np.nan], [np.nan, 0.6, np.nan]])
    guide = EmgGuide(values, "target", 1e6)
    trial = replace(trial, problems=replace(trial.problems, guide=guide))
    for k in range(2):
        _, (activation, *_, status) = trial.solved(k, MOMENT, 0.0, ARMS[1:])
        assert status == "ok"
        assert activation[1] == pytest.approx(values[k, 1], abs=1e-4)


def test_agreement_states_correlation_error_and_lag():
    """The activation has half the size of the envelope and is 60 ms later."""
    values = np.exp(-(((TIME - 2.0) / 0.3) ** 2))
    envelopes = Envelopes(None, TIME, {"VL": values}, {"vaslat": "VL"}, {"VL": 1.0})
    time = np.arange(0.5, 3.5, 1 / 30)
    activation = 0.5 * envelopes.at("vaslat", time - 0.06)
    activation[[3, 40]] = np.nan
    columns = {"time_s": time, "activation_vaslat": activation}
    result = compare_emg(envelopes, columns)["vaslat"]
    finite, expected = np.isfinite(activation), envelopes.at("vaslat", time)
    activation, expected = activation[finite], expected[finite]
    assert result["lag_s"] == pytest.approx(0.06, abs=0.0026)
    assert result["pearson_r"] == pytest.approx(np.corrcoef(activation, expected)[0, 1])
    assert result["rmse"] == pytest.approx(np.std(activation - expected, mean=0.0))
    assert (result["frames_compared"], result["frames_left_out"]) == (len(time) - 2, 2)


def test_the_fitted_normalisation_makes_the_envelope_the_activation():
    """Two muscles of a channel have 0.3 and 0.5 of its envelope, so that 0.4 is the best fit."""
    values = np.exp(-(((TIME - 2.0) / 0.3) ** 2))
    names = {"vaslat": "VL", "vasint": "VL", "soleus": "SO"}
    channels = {"VL": values, "SO": values}
    envelopes = Envelopes(None, TIME, channels, names, {"VL": 2e-4, "SO": 1.0})
    time = np.arange(0.5, 3.5, 1 / 30)
    course = envelopes.at("vaslat", time)
    columns = {"activation_vaslat": 0.3 * course, "activation_vasint": 0.5 * course}
    columns |= {"time_s": time, "activation_soleus": np.full_like(time, np.nan)}
    columns["activation_vaslat"][[7]] = columns["activation_vasint"][[7]] = np.nan
    result = fitted_normalisation(envelopes, columns)
    assert result["VL"] == pytest.approx(2e-4 / 0.4)
    assert result["SO"] is None


@pytest.mark.parametrize("shape", [lambda t: np.exp(-((t - 2.5) ** 2)), lambda t: 3 * t])
def test_a_lag_outside_the_range_is_nan(shape):
    """The activation is 0.5 s late, or a ramp, with the same correlation at all lags."""
    values = {"VL": TIME if shape(1.0) == 3.0 else np.exp(-((TIME - 2.0) ** 2))}
    envelopes = Envelopes(None, TIME, values, {"vaslat": "VL"}, {"VL": 1.0})
    time = np.arange(1.0, 3.0, 1 / 30)
    columns = {"time_s": time, "activation_vaslat": shape(time)}
    assert np.isnan(compare_emg(envelopes, columns)["vaslat"]["lag_s"])
