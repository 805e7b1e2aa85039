"""Model discrepancy: fit to trials, band with samples, and sentence in the summary."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from tkamb.io.scene.uncertainty import FLUOROSCOPY_ERROR, SKIN_MARKER_ERROR, UncertaintyTable
from tkamb.run.claims import peaks
from tkamb.run.discrepancy import (
    COLUMNS,
    FORCES,
    Discrepancy,
    band_with_discrepancy,
    coverage,
    discrepancy_of,
    fitted,
    known_errors,
    load_of,
    trial_error,
)
from tkamb.run.summary import saturated_muscles
from tkamb.studies.uncertainty.bands import discrepancy_columns, influences


def one_trial(
    rng, name="a", activity="walking", bias=0.0, scatter=0.2, inputs=0.1, frames=40, count=50
):
    """Return error, samples, measured force and load of a synthetic trial.

    The error is a bias plus white noise, as shares of the load. The samples scatter about the
    nominal force.
    """
    nominal = 700.0 * (1.5 + np.sin(np.linspace(0, 6, frames)))
    load = np.hypot(nominal, 350.0)
    truth = nominal + load * (bias + scatter * rng.standard_normal(frames))
    samples = nominal + load * inputs * rng.standard_normal((count, frames))
    time = np.arange(frames) / 30
    names = (name, "S", activity, "total")
    median_load = load_of(samples, 700.0)
    error = trial_error(names, time, samples, truth, nominal, median_load)
    return error, samples, truth, median_load


def test_the_fit_recovers_bias_scatter_and_deviation_of_the_inputs():
    error, _, _, _ = one_trial(np.random.default_rng(0), bias=0.3, frames=2000, count=200)
    assert error.bias == pytest.approx(0.3, abs=0.02)
    assert error.scatter == pytest.approx(0.2, abs=0.01)
    assert error.inputs == pytest.approx(0.1, abs=0.005)
    assert error.independent_frames == pytest.approx(2000.0, rel=0.05)


def test_the_load_is_the_median_total_and_never_below_half_a_body_weight():
    totals = np.array([[700.0, 0.0, np.nan], [1400.0, 0.0, np.nan], [2100.0, 0.0, np.nan]])
    load = load_of(totals, 700.0)
    np.testing.assert_allclose(load[:2], [np.hypot(1400.0, 350.0), 350.0])
    assert np.isnan(load[2])


def test_the_fit_recovers_the_correlation_time_of_an_ar1_process():
    rng, step, tau = np.random.default_rng(1), 1 / 30, 0.2
    rho, noise = np.exp(-step / tau), [0.0]
    for _ in range(6000):
        noise.append(rho * noise[-1] + np.sqrt(1 - rho**2) * rng.standard_normal())
    truth = 700.0 * (2.0 + 0.1 * np.array(noise))
    nominal = np.full(len(truth), 1400.0)
    names = ("a", "S", "walking", "total")
    time = np.arange(len(truth)) * step
    error = trial_error(names, time, np.tile(nominal, (30, 1)), truth, nominal, nominal)
    assert error.correlation_s == pytest.approx(tau, rel=0.1)
    # the variance of an AR(1)'s variance is (1 + rho²)/(1 - rho²) times that of white noise
    share = (1 - rho**2) / (1 + rho**2)
    assert error.independent_frames == pytest.approx(6001 * share, rel=0.1)


def test_the_band_of_inputs_and_discrepancy_covers_another_trial():
    rng, shares = np.random.default_rng(2), []
    for _ in range(150):
        of_activity = rng.standard_normal()  # m and b of tkamb.run.discrepancy with S = 0.4
        biases = 0.4 * (of_activity + rng.standard_normal(9)) / np.sqrt(2)
        trials = [one_trial(rng, str(k), bias=bias, frames=10) for k, bias in enumerate(biases)]
        discrepancy = fitted([one[0] for one in trials[1:]], "total", "walking")
        _, samples, truth, load = trials[0]
        shares.append(coverage(*band_with_discrepancy(samples, discrepancy, load), truth)[1])
    assert 0.85 <= np.mean(shares) <= 0.95


def test_only_the_bias_of_the_same_activity_shifts_a_band():
    rng = np.random.default_rng(3)
    trials = [one_trial(rng, str(k), "squat", -0.5)[0] for k in range(3)]
    squat, other = (fitted(trials, "total", one) for one in ("squat", "stairs up"))
    assert squat.mean == pytest.approx(-0.375, abs=0.05)  # 3/4 of the mean bias
    assert other.mean == 0.0 and other.deviation > squat.deviation
    assert fitted(trials, "medial", "squat") is None


def test_a_fit_to_more_independent_frames_has_more_degrees_of_freedom():
    error, _, _, _ = one_trial(np.random.default_rng(5), bias=0.1, scatter=0.4)
    lengths = [replace(error, independent_frames=n) for n in (3.0, 10.0, 100.0)]
    freedoms = [fitted([one], "total", "walking").freedom for one in lengths]
    assert freedoms == sorted(freedoms) and freedoms[-1] > 1.05 * freedoms[0]


def test_a_band_with_discrepancy_is_never_negative_and_nan_without_samples():
    samples = np.full((30, 2), 100.0)
    samples[:, 1] = np.nan
    discrepancy = Discrepancy(0.0, 1.0, 4.0, 1, 3)
    low, high = band_with_discrepancy(samples, discrepancy, np.full(2, 700.0))
    # Student's t of four degrees of freedom, cut off at zero force
    t = stats.t(4.0, loc=100.0, scale=700.0)
    for end, share in ((low[0], 0.05), (high[0], 0.95)):
        expected = t.ppf(t.cdf(0.0) + share * t.sf(0.0))
        assert end == pytest.approx(expected, rel=0.05, abs=20.0)
    assert low[0] > 0.0
    assert np.isnan([low[1], high[1]]).all()
    assert np.isnan(band_with_discrepancy(samples[:, 1:], discrepancy, np.full(1, 700.0))).all()


SUMMARY = {"scene_tables": {"muscles": {}}, "activity": "squat"}


def test_the_package_has_errors_of_three_trials_of_one_subject():
    errors = known_errors()
    assert {error.force for error in errors} == set(FORCES)
    assert {error.trial for error in errors} == {"ngait_og3", "ngait_og1", "squat"}
    assert {error.subject for error in errors} == {"JW"}
    assert set(discrepancy_of(SUMMARY)) == set(FORCES)
    assert discrepancy_of({"activity": "squat"}) == {}


def test_columns_and_peaks_have_the_band_with_discrepancy():
    rng = np.random.default_rng(4)
    values = 1400.0 + 70.0 * rng.standard_normal((60, 2, 3))
    columns = discrepancy_columns(["force_si_N", "quadriceps_N"], values, SUMMARY, 700.0)
    assert set(columns) == {f"force_si_N_discrepancy_{end}" for end in ("p05", "p95")}
    bands = columns | {f"force_si_N_{end}": np.full(3, 1.0) for end in ("p05", "p50", "p95")}
    rows = {"time_s": np.arange(3.0), "flexion_deg": np.arange(3.0), "status": ["ok"] * 3}
    nominal = rows | {"force_si_N": np.array([1.0, 1400.0, 2.0])}
    peak = peaks(nominal, bands, 700.0)["total"]
    assert (peak["frame"], peak["nominal"]) == (1, 2.0)
    assert peak["discrepancy_p95"] - peak["discrepancy_p05"] > 0.3
    assert set(COLUMNS.values()) == set(FORCES)


def test_peaks_and_saturated_muscles_of_a_run():
    nan = np.nan
    columns = {
        "time_s": np.arange(3.0),
        "status": ["failed: x", "ok", "ok"],
        "flexion_deg": np.array([1.0, 2.0, 3.0]),
        "force_si_N": np.array([nan, 1400.0, 700.0]),
        "medial_force_N": np.full(3, nan),
        "medial_force_equilibrium_N": np.array([nan, 350.0, 700.0]),
        "activation_vaslat": np.array([nan, 1.0, 0.3]),
        "activation_soleus": np.array([nan, 0.2, 0.3]),
    }
    peak = peaks(columns, {}, 700.0)
    total = {"nominal": 2.0, "frame": 1, "time_s": 1.0, "flexion_deg": 2.0}
    assert peak["total"] == total | {"column": "force_si_N", "supported": True}
    assert peak["medial"]["nominal"] == 1.0 and "lateral" not in peak
    assert saturated_muscles(columns) == {"vaslat": 1}


def test_default_errors_depend_on_the_recording_and_errors_of_the_scene_are_unchanged():
    markers, fluoroscopy = (UncertaintyTable().completed(one) for one in (True, False))
    assert fluoroscopy.flexion_deg == FLUOROSCOPY_ERROR.flexion_deg
    assert markers.flexion_deg == SKIN_MARKER_ERROR.flexion_deg
    table = UncertaintyTable.model_validate({"flexion_deg": 0.1, "ap_mm": 0.0})
    assert table.completed(True).flexion_deg == 0.1 and table.completed(True).ap_mm == 0.0


def test_the_influential_input_is_identified_with_few_samples():
    rng, count = np.random.default_rng(5), 60
    x = rng.standard_normal((100, 1, count))
    y = (3.0 * x[:, :, 7] + 0.3 * rng.standard_normal((100, 1)))[:, None, :]
    rows = influences(["y"], [str(k) for k in range(count)], y, x)
    assert rows[0].name == "7" and rows[0].share > 0.9
    assert rows[0].change == pytest.approx(3.0, abs=0.2)
    assert abs(sum(row.share for row in rows[1:-1])) < 0.5  # without the share by chance
