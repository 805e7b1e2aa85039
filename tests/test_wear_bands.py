"""Bands of wear: closed forms for wear that is proportional to the varied input."""

import csv
import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

import shapes
from interrupted_runs import broken_off
from scenes import write_scene
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.geometry.frames import KNEE_COORDINATES, knee_coordinates
from tkamb.io.scene.uncertainty import UncertaintyTable
from tkamb.run.recorder import Shards
from tkamb.run.workers import PoolOptions
from tkamb.studies.uncertainty.inputs import Draw, VariedInput
from tkamb.studies.wear.bands import Sampling, check_samples, moved_case, varied_wear_inputs
from tkamb.studies.wear.engine import ArticularSurface
from tkamb.studies.wear.laws import Archard, LogarithmicCreep
from tkamb.studies.wear.run import prepare_wear
from tkamb.studies.wear.simulation import WearCase, simulate_wear
from wear_bodies import DENSITY, MM, Pressed, always, ball_case, balls_scene, stroke, swing

FACTOR = VariedInput("wear_factor", 0.44, "relative")
CYCLES = 1_000_000
SPREAD = np.sqrt(np.log1p(0.44**2))


def small_case(wear_factor=1e-6, creep=None):
    plate = shapes.block(lambda x, z: 0.01 + 0 * x, 8 * MM, 8 * MM, 4 * MM)
    surface = ArticularSurface.of_insert(plate, 4 * MM)
    law = Archard(wear_factor)
    return WearCase(Pressed(always), surface, stroke(12 * MM, 3, 100.0), law, DENSITY, creep)


def sampled(case, inputs=(FACTOR,), samples=20, **options):
    state, _ = simulate_wear(case, CYCLES, 2)
    sampling = Sampling(inputs, np.eye(len(inputs)), samples, 1, 0.5)
    return sampling.bands((case, CYCLES, 2), state.rows, **options), state.rows


def test_a_plate_has_the_band_of_its_wear_factor():
    """Volume and depth are proportional to k, so their quantiles are log-normal."""
    bands, rows = sampled(small_case(), samples=64)
    for end, probability in (("p05", 0.05), ("p50", 0.5), ("p95", 0.95)):
        factor = np.exp(SPREAD * norm.ppf(probability) - 0.5 * SPREAD**2)
        for name in ("volume_mm3", "max_depth_mm"):
            for row, band in zip(rows[1:], bands.rows[1:], strict=True):
                assert band[f"{name}_{end}"] == pytest.approx(factor * row[name], rel=0.05)
    assert np.exp(SPREAD * norm.ppf(0.95)) == pytest.approx(2.0, rel=0.01)
    assert bands.rows[0]["volume_mm3_p95"] == 0.0
    assert (bands.failed, bands.ended) == (0, 0)


def test_creep_has_the_band_of_its_constants_alone():
    law = LogarithmicCreep(3e-3, 8e-4, 1.0)
    inputs = (VariedInput("creep", 0.2, "relative"),)
    bands, _ = sampled(small_case(0.0, law), inputs, samples=128)
    low, high = (bands.rows[-1][f"creep_depth_mm_{end}"] for end in ("p05", "p95"))
    spread = np.sqrt(np.log1p(0.2**2))
    assert high / low == pytest.approx(np.exp(2 * spread * norm.ppf(0.95)), rel=0.05)
    assert bands.rows[-1]["volume_mm3_p95"] == 0.0
    factor_bands, _ = sampled(small_case(1e-6, law))
    creep_limits = {factor_bands.rows[-1][f"creep_depth_mm_{end}"] for end in ("p05", "p95")}
    assert max(creep_limits) == pytest.approx(min(creep_limits), rel=1e-3)


def test_later_bands_exclude_samples_that_wear_through():
    """The nominal depth is 80 % of the thickness of 9.9 mm. Samples with larger k wear through."""
    depth = 100.0 / 64 * 24e-3 * CYCLES  # mm per mm³/(N m)
    bands, _ = sampled(small_case(0.8 * 9.9 / depth), samples=64)
    assert 10 < bands.ended < 32
    assert bands.rows[-1]["max_depth_mm_p95"] < 9.9
    assert f"{bands.ended} of 64 samples wore through" in bands.questions()[0]
    no_bands, _ = sampled(small_case(1.5 * 9.9 / depth))
    assert np.isnan(no_bands.rows[-1]["volume_mm3_p50"])  # more than half wear through


def test_the_constant_part_of_a_pose_error_moves_the_whole_cycle():
    inputs = (VariedInput("ap", 2.0, "mm"), VariedInput("axial_rotation", 3.0, "deg"))
    case = small_case()
    moved = moved_case(case, Draw(inputs, np.array([1.0, -2.0]), np.zeros((1, 0)), 0.25))
    shift = knee_coordinates(moved.motion.poses) - knee_coordinates(case.motion.poses)
    expected = {"ap": 0.5 * 2.0 * MM, "axial_rotation": -0.5 * np.radians(6.0)}
    for name, column in zip(KNEE_COORDINATES, shift.T, strict=True):
        assert column == pytest.approx(expected.get(name, 0.0), abs=1e-12)
    assert moved.motion.load is case.motion.load


def test_the_pose_of_a_profile_varies_only_by_stated_deviations():
    case = small_case()
    table = UncertaintyTable.model_validate({"ap_mm": 0.5})
    names = {varied.name for varied in varied_wear_inputs(table, case.motion, None, True)}
    assert names == {"ap", "wear_factor"}
    recorded = {varied.name for varied in varied_wear_inputs(table, case.motion, None, False)}
    assert recorded == {"ap", "ml", "adduction", "axial_rotation", "flexion", "wear_factor"}
    constant = UncertaintyTable.model_validate({"wear_factor": 0.0})
    with pytest.raises(InputError, match="nothing of a wear simulation varies"):
        varied_wear_inputs(constant, case.motion, None, True)


def test_correlations_of_wear_inputs_are_used():
    pairs = [
        {"between": ["ap", "wear_factor"], "coefficient": 0.6},
        {"between": ["ap", "tuberosity.ap"], "coefficient": 0.9},
    ]
    table = UncertaintyTable.model_validate({"ap_mm": 0.5, "correlation": pairs})
    case = small_case()
    sampling = Sampling.of(SimpleNamespace(uncertainty=table, simulated=True), case, 20)
    covariance = dict(zip(("ap", "wear_factor"), sampling.root @ sampling.root.T, strict=True))
    assert covariance["ap"] == pytest.approx([1.0, 0.6])
    assert covariance["wear_factor"] == pytest.approx([0.6, 1.0])


def test_the_factor_of_a_creep_law_multiplies_its_strain():
    law = LogarithmicCreep(1e-3, 2e-4, 10.0)
    assert law.times(1.3).strain_per_pascal(5e5) == pytest.approx(1.3 * law.strain_per_pascal(5e5))


def test_resumed_samples_give_the_same_band(tmp_path):
    case, identity = small_case(), {"wear simulation": "x"}
    uninterrupted, _ = sampled(case)
    first_shards = Shards(tmp_path, identity, False, ".samples")
    with pytest.raises(KeyboardInterrupt, match="8 of 20 samples are kept"):
        sampled(case, shards=first_shards, progress=broken_off(8))
    sample_counts = []

    def record_count(samples, count):
        sample_counts.append(count)
        return samples

    resumed_shards = Shards(tmp_path, identity, True, ".samples")
    resumed, _ = sampled(case, shards=resumed_shards, progress=record_count)
    assert sample_counts == [12]
    assert resumed.rows == uninterrupted.rows


@pytest.mark.parametrize("samples", [-1, 5, 10**6])
def test_too_few_or_too_many_samples_are_refused(samples):
    with pytest.raises(InputError, match="samples"):
        check_samples(samples)


@pytest.mark.slow
def test_a_scene_with_uncertainty_has_bands_in_every_output(capsys, tmp_path):
    cycle = tmp_path / "cycle.csv"
    cycle.write_text(
        "cycle_percent,axial_force_N,flexion_deg\n0,300,0\n50,900,30\n100,300,0\n", "utf-8"
    )
    scene = balls_scene(tmp_path / "scene")
    with open(scene, "a", encoding="utf-8") as file:
        file.write("\n[uncertainty]\nwear_factor = 0.6\nml_mm = 1.0\n")
    options = ("--simulator", str(cycle), "--resolution", "4", "--frames-per-cycle", "3")
    options = (*options, "--updates", "1", "--cycles", "1000")
    assert main(["wear", str(scene), *options, "--out", str(tmp_path / "out")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "factor of two" in lines[0]
    assert any(line.startswith("5 to 95 % of 32 samples: volume") for line in lines)
    report = json.loads((tmp_path / "out/wear.json").read_text())
    with open(tmp_path / "out/wear.csv", encoding="utf-8") as file:
        last = list(csv.DictReader(file))[-1]
    low, high = (report["bands"][f"volume_mm3_{end}"] for end in ("p05", "p95"))
    assert 0 < low < report["volume_mm3"] < high
    assert float(last["volume_mm3_p95"]) == high
    assert report["bands"]["standard_deviations"] == {"ml (mm)": 1.0, "wear_factor (relative)": 0.6}
    assert "loads" in report["bands"]["not_varied"]
    assert not (tmp_path / "out/.wear_samples").exists()


@pytest.mark.parametrize("table", [None, {"wear_factor": 0.6}])
def test_only_a_scene_with_uncertainty_has_bands_without_being_asked(tmp_path, table):
    """A sample takes as long as the simulation, so that 32 are asked for."""
    changes = {} if table is None else {"uncertainty": table}
    scene = write_scene(tmp_path / "scene", contact__resolution_mm=4.0, **changes)
    run = prepare_wear(scene, cycles=1000, updates=1, frames=2)
    assert (0 if run.sampling is None else run.sampling.samples) == (32 if table else 0)
    asked = prepare_wear(scene, cycles=1000, updates=1, frames=2, samples=20)
    assert {one.name for one in asked.sampling.inputs} >= {"wear_factor", "ap", "adduction"}


@pytest.mark.slow
def test_two_workers_give_the_bands_of_one():
    """Modulus and pose vary too, so each worker prepares the contact of every sample."""
    case = ball_case(shapes.trough(0.03), 20 * MM, swing(0.5, 3, 500.0), 1e-7, 3.0)
    inputs = (VariedInput("ap", 0.5, "mm"), VariedInput("young_modulus", 0.1, "relative"), FACTOR)
    single, rows = sampled(case, inputs)
    parallel, _ = sampled(case, inputs, crew=PoolOptions(2))
    assert parallel.rows == single.rows
    low, high = (single.rows[-1][f"volume_mm3_{end}"] for end in ("p05", "p95"))
    assert 0 < low < rows[-1]["volume_mm3"] < high
