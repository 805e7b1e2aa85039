"""Bands: propagation with closed forms, reproducible samples, and cases with varied inputs."""

import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from faults import Faults
from interrupted_runs import broken_off, held_elsewhere
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.io.claim import settle
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.run.recorder import Shard, Shards
from tkamb.run.results_folder import BANDS_NAME, UNCERTAINTY_NAMES, write_results
from tkamb.run.simulation import simulate
from tkamb.studies.uncertainty.bands import (
    band_columns,
    causes,
    influences,
    measured_inside,
    percentiles,
)
from tkamb.studies.uncertainty.inputs import Draw, Point, noise, normal_samples
from tkamb.studies.uncertainty.run import estimate_uncertainty, write_uncertainty
from tkamb.studies.uncertainty.sample import Sampler

pytestmark = pytest.mark.usefixtures("plain_report")

SCENE = Path(__file__).parents[1] / "models" / "deep_knee_bend" / "scene.toml"
SLOPES = np.array([3.0, -2.0, 1.0, 0.5])
LINEAR_SD = float(np.linalg.norm(SLOPES))
Z95 = 1.6448536269514722


def knee(**more):
    """Return the scene of the shipped knee with a coarse foundation and changed keys."""
    coarse = {"contact.model": "foundation", "contact.resolution_mm": 4.0}
    return load_scene(SCENE, coarse | {key.replace("__", "."): v for key, v in more.items()})


def bodies_alone(**more):
    """Return the scene without contact, muscles and patella, which needs no mesh."""
    parts = ("contact", "quadriceps", "patellar_ligament", "patella")
    return knee(**more).model_copy(update=dict.fromkeys(parts))


@pytest.mark.parametrize("method", ["lhs", "sobol"])
def test_a_linear_map_of_gaussian_inputs_has_its_known_distribution(method):
    count = 1024
    y = 10.0 + normal_samples(method, count, len(SLOPES), seed=3) @ SLOPES
    assert y.mean() == pytest.approx(10.0, abs=3 * LINEAR_SD / np.sqrt(count))
    assert y.std() == pytest.approx(LINEAR_SD, rel=3 / np.sqrt(2 * count))
    band = percentiles(y)
    # standard error of a quantile: sqrt(p (1 - p) / n) / density there
    error = np.sqrt(0.05 * 0.95 / count) / (np.exp(-0.5 * Z95**2) / np.sqrt(2 * np.pi))
    assert band["p05"] == pytest.approx(10.0 - Z95 * LINEAR_SD, abs=3 * error * LINEAR_SD)
    assert band["p50"] == pytest.approx(10.0, abs=3 * 1.2533 * LINEAR_SD / np.sqrt(count))
    assert band["p95"] == pytest.approx(10.0 + Z95 * LINEAR_SD, abs=3 * error * LINEAR_SD)


def test_the_band_covers_the_truth_in_90_per_cent_of_trials():
    rng, covered = np.random.default_rng(0), 0
    for trial in range(200):
        recorded = rng.standard_normal(len(SLOPES))  # the true inputs are 0
        y = (recorded + normal_samples("lhs", 256, len(SLOPES), seed=trial)) @ SLOPES
        band = percentiles(y)
        covered += band["p05"] <= 0.0 <= band["p95"]
    assert 0.85 <= covered / 200 <= 0.95


@pytest.mark.parametrize("count", [20, 40, 200])
def test_a_new_draw_is_within_the_band_for_any_number_of_samples(count):
    draws = np.random.default_rng(count).standard_normal((count + 1, 4000))
    band = percentiles(draws[1:])
    inside = (band["p05"] <= draws[0]) & (draws[0] <= band["p95"])
    error = np.sqrt(0.9 * 0.1 / inside.size)
    assert inside.mean() == pytest.approx(0.90, abs=3 * error)


def test_shares_of_a_linear_map_are_its_squared_slopes():
    rng = np.random.default_rng(1)
    x = normal_samples("lhs", 2048, len(SLOPES), seed=1)
    y = x @ SLOPES + 2.0 * rng.standard_normal(len(x))
    rows = influences(["y"], list("abcd"), y[:, None, None], x[:, None, :])
    shares = {row.name: row.share for row in rows}
    total = LINEAR_SD**2 + 4.0
    for name, slope in zip("abcd", SLOPES, strict=True):
        assert shares[name] == pytest.approx(slope**2 / total, abs=0.03)
    assert shares["rest"] == pytest.approx(4.0 / total, abs=0.03)
    assert [row.name for row in rows] == ["a", "b", "c", "d", "rest"]
    assert rows[1].change == pytest.approx(-2.0, abs=0.15)
    square = (x[:, 0] ** 2)[:, None, None]  # all variance is that of the first input
    assert influences(["y"], list("abcd"), square, x[:, None, :])[0].share > 0.999


@pytest.mark.parametrize("method", ["lhs", "sobol"])
def test_a_larger_number_of_samples_includes_the_smaller_one(method):
    many = normal_samples(method, 300, 5, seed=7)
    np.testing.assert_array_equal(normal_samples(method, 70, 5, seed=7), many[:70])
    assert not np.array_equal(normal_samples(method, 70, 5, seed=8), many[:70])


def test_noise_is_stationary_with_its_correlation_time():
    time, tau = np.array([0.0, 0.05, 0.30]), 0.1
    x = np.array([noise(n, time, 2, tau, seed=1) for n in range(4000)])
    np.testing.assert_allclose(x.var(axis=0), 1.0, atol=0.1)
    for first, second in ((0, 1), (1, 2)):
        rho = np.exp(-(time[second] - time[first]) / tau)
        assert np.mean(x[:, first] * x[:, second]) == pytest.approx(rho, abs=0.04)
    assert np.mean(x[:, :, 0] * x[:, :, 1]) == pytest.approx(0.0, abs=0.04)
    np.testing.assert_array_equal(noise(5, time, 2, tau, seed=1), x[5])


def test_a_frame_that_failed_in_most_samples_has_no_band():
    values = np.tile(np.arange(100.0)[:, None, None], (1, 1, 2))
    failed = np.zeros((100, 2), bool)
    failed[:60, 0] = failed[:10, 1] = True
    values[failed[:, None, :]] = np.nan
    columns = band_columns(np.arange(2.0), ["force_total_N"], values, failed)
    np.testing.assert_allclose(columns["failed_share"], [0.6, 0.1])
    assert np.isnan(columns["force_total_N_p50"][0])
    assert columns["force_total_N_p50"][1] == pytest.approx(54.5)  # samples 10 to 99


def test_the_share_inside_the_band_counts_only_frames_with_force_and_band():
    nan = float("nan")
    columns = {"measured_total_N": np.array([100.0, 300.0, nan, 120.0, 90.0])}
    bands = {
        "force_si_N_p05": np.array([90.0, 100.0, 90.0, nan, 90.0]),
        "force_si_N_p95": np.array([110.0, 200.0, 110.0, nan, 110.0]),
    }
    shares = measured_inside(columns, bands, {"total": {"predicted": "force_si_N"}})
    assert shares == {"total": {"frames": 3, "share": pytest.approx(2 / 3)}}
    no_band = measured_inside(columns, {}, {"total": {"predicted": "force_si_N"}})
    assert no_band["total"]["frames"] == 0 and np.isnan(no_band["total"]["share"])


def draw_of(sampler, **normal):
    """Return a draw with errors of the named inputs, in standard deviations."""
    names = [varied.name for varied in sampler.inputs]
    values = np.zeros(len(names))
    for name, value in normal.items():
        values[names.index(name.replace("__", "."))] = value
    frames = len(sampler.case.motion.time)
    return Draw(sampler.inputs, values, np.zeros((frames, 6)), 1.0)


def sampled(sampler, monkeypatch, **normal):
    monkeypatch.setattr(sampler, "draw", lambda point: draw_of(sampler, **normal))
    return sampler(0, Point.of(0, np.zeros(0))).values


def test_a_sample_equals_a_run_of_the_changed_scene(monkeypatch):
    names = ["force_total_N", "medial_force_N", "ligament_LCL_N", "quadriceps_N"]
    table = {"uncertainty__ligament_strain": 0.02}
    # the factors of these inputs have mean 1, but not median 1
    factors = ("ligament_stiffness", "segment_mass", "ground_reaction")
    table |= {f"uncertainty__{name}": 0.0 for name in factors}
    scene, frames = knee(**table), slice(60, 61)
    sampler = Sampler(scene, range(60, 61), names)
    nominal = simulate(scene, frames=frames)
    nominal_values = sampled(sampler, monkeypatch)
    np.testing.assert_allclose(nominal_values, [nominal[name] for name in names], rtol=1e-12)

    errors = {"ligament_strain__LCL": 2.0, "friction": 1.0}
    bundles = tuple(
        bundle.model_copy(update={"slack_length_mm": bundle.slack_length_mm / 1.04})
        if bundle.name == "LCL"
        else bundle
        for bundle in scene.ligament
    )
    assert scene.contact is not None
    changed = scene.model_copy(
        update={
            "ligament": bundles,
            "contact": scene.contact.model_copy(update={"friction": 0.05 + 0.017}),
        }
    )
    expected = simulate(changed, frames=frames)
    values = sampled(sampler, monkeypatch, **errors)
    np.testing.assert_allclose(values, [expected[name] for name in names], rtol=1e-9)
    assert np.abs(values - nominal_values).max() > 1.0


def test_a_changed_chain_has_other_masses_and_insert_position():
    chain, shift = load_case(bodies_alone()).chain, np.array([1e-3, 2e-3, -3e-3])
    other = chain.changed(1.5, shift)
    for link in ("tibia", "femur"):
        (mass, centre, inertia), (other_mass, other_centre, other_inertia) = (
            chain.segment(link),
            other.segment(link),
        )
        assert other_mass == pytest.approx(1.5 * mass)
        np.testing.assert_allclose(other_inertia, 1.5 * inertia)
        np.testing.assert_allclose(other_centre, centre)
    rotation = chain.insert_in_tibia[:3, :3]
    np.testing.assert_allclose(
        other.insert_in_tibia[:3, 3], chain.insert_in_tibia[:3, 3] + rotation @ shift
    )


def test_a_resumed_analysis_with_two_workers_gives_the_bands_of_one(tmp_path):
    scene = bodies_alone(uncertainty__ligament_strain=0.02, uncertainty__segment_mass=0.1)
    folder, options = tmp_path / "out", {"samples": 40, "frames": slice(0, 101, 25)}

    with pytest.raises(KeyboardInterrupt, match="4 of 40 samples are kept"):
        estimate_uncertainty(scene, **options, directory=folder, progress=broken_off(4))
    assert not (folder / BANDS_NAME).exists()
    identity = json.loads((folder / ".frames" / "run.json").read_text())
    forged = Shard({}, {"values": np.zeros(2)})  # stored with a valid digest
    Shards(folder, identity, resume=True).put(1, forged)
    with pytest.raises(InputError, match="is damaged"):
        estimate_uncertainty(scene, **options, directory=folder, resume=True)
    (folder / ".frames" / "000001.frame").unlink()
    single = estimate_uncertainty(scene, **options)
    resumed = estimate_uncertainty(scene, **options, directory=folder, resume=True, workers=2)
    for name, band in single.bands.items():
        np.testing.assert_array_equal(band, resumed.bands[name])
    for sample, resumed_sample in zip(single.samples, resumed.samples, strict=True):
        np.testing.assert_array_equal(sample.values, resumed_sample.values)
        np.testing.assert_array_equal(sample.errors, resumed_sample.errors)
    assert main(["verify", str(folder)]) == 0
    with pytest.raises(InputError, match="holds what `tkamb uncertainty` wrote"):
        write_results(single.results, folder)
    write_results(single.results, folder, force=True)  # removes the bands
    assert not any((folder / name).exists() for name in UNCERTAINTY_NAMES)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--samples", "0"], "cannot be 0; give a number from 20"),
        (["--workers", "0"], "cannot be 0; give a number from 1"),
        (["--method", "dice"], "unknown method 'dice'"),
        (["--set", "uncertainty.ap_mm=-1"], "greater than or equal to 0"),
        (["--set", "uncertainty.ap=1"], "unknown key 'uncertainty.ap'"),
        (["--frames", "500:600"], "not in the motion"),
    ],
)
def test_invalid_input_is_an_error_of_one_line(arguments, words, tmp_path, capsys):
    folder = tmp_path / "out"
    assert main(["uncertainty", str(SCENE), "--out", str(folder), *arguments]) == 2
    message = capsys.readouterr().err.strip()
    assert words in message and "\n" not in message
    assert not folder.exists()


def test_a_scene_without_varied_inputs_is_refused():
    keys = [f"uncertainty__{key}" for key in ("ap_mm", "si_mm", "ml_mm", "friction")]
    keys += [f"uncertainty__{key}_deg" for key in ("axial_rotation", "adduction", "flexion")]
    keys += [f"uncertainty__centre_of_pressure_{axis}_mm" for axis in ("ap", "ml")]
    keys += [f"uncertainty__{key}" for key in ("segment_mass", "ground_reaction")]
    keys += [f"uncertainty__ligament_{key}" for key in ("stiffness", "strain")]
    keys += [f"uncertainty__{key}_mm" for key in ("knee_centre", "femoral_placement")]
    keys += [f"uncertainty__insert_placement_{unit}" for unit in ("mm", "deg")]
    with pytest.raises(Exception, match="no input varies"):
        estimate_uncertainty(bodies_alone(**dict.fromkeys(keys, 0.0)), samples=20)


def test_a_folder_in_use_is_refused(tmp_path):
    folder, message = tmp_path / "out", "another tkamb is writing into this folder"
    with held_elsewhere(folder), pytest.raises(InputError, match=message):
        estimate_uncertainty(bodies_alone(), samples=20, directory=folder)
    assert [path.name for path in folder.iterdir()] == [".tkamb"]


def test_a_full_disk_leaves_all_files_or_none(tmp_path, monkeypatch):
    uncertainty = estimate_uncertainty(bodies_alone(), samples=20, frames=slice(0, 1))

    def write(folder, number=None):
        folder.mkdir()
        injected = Faults(folder, number).injected(monkeypatch)
        with injected as faults, suppress(InputError):
            write_uncertainty(uncertainty, folder, report=lambda results: "page")
        settle(folder)
        expected = {"bands.csv", "tornado.csv", "samples.h5", "results.csv", "summary.json"}
        return faults.calls, expected, expected & {path.name for path in folder.iterdir()}

    calls, expected, written = write(tmp_path / "whole")
    assert written == expected
    for number in range(len(calls)):
        assert write(tmp_path / f"full{number}", number)[2] in (set(), expected)


def test_causes_of_failure_are_counted_without_their_numbers():
    problems = np.array(
        [
            ["", "contact out of range; a load of 800 N cannot be reached; no ellipse"],
            ["contact out of range; a load of 1.5e3 N cannot be reached; no ellipse", ""],
            ["", "a load of 900.25 N cannot be reached"],
        ]
    )
    assert causes(problems) == {
        "no ellipse": pytest.approx(2 / 3),
        "a load of … N cannot be reached": pytest.approx(1 / 3),
    }
    assert causes(np.full((2, 3), "")) == {}


def test_a_failed_sample_has_its_reason(monkeypatch):
    """After a lateral shift of 60 standard deviations both condyles touch one wall."""
    sampler = Sampler(knee(), range(60, 61), ["force_total_N"])
    monkeypatch.setattr(sampler, "draw", lambda point: draw_of(sampler, ml=60.0))
    sample = sampler(0, Point.of(0, np.zeros(0)))
    assert sample.failed.tolist() == [True] and np.isnan(sample.values).all()
    assert sample.problems[0].startswith("condyles apart by ")
