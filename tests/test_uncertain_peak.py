"""Printed peak of an uncertain run, varied tendon bands, and a patella without equilibrium."""

import csv
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest

from mirrored_patient import write_mirrored_patient
from scenes import write_scene
from tkamb.commands.uncertainty import headline
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee.muscles import SagittalWrap
from tkamb.run.results import Results
from tkamb.run.simulation import simulate
from tkamb.show.axis import horizontal_axis
from tkamb.show.headline import cards
from tkamb.studies.uncertainty.bands import band_columns, peak_band
from tkamb.studies.uncertainty.inputs import Draw, Point, VariedInput, varied_inputs
from tkamb.studies.uncertainty.run import estimate_uncertainty
from tkamb.studies.uncertainty.sample import Sampler, varied_case

NOMINAL = np.array([1.0, 3.39, 2.0])


def samples(failed=0):
    """Return 100 samples with peaks from 3.31 to 4.30 BW in steps of 0.01, and their failures."""
    values = np.tile(NOMINAL, (100, 1))
    values[:, 1] = 3.31 + 0.01 * np.arange(100)
    values[:failed, 1] = np.nan
    failures = np.zeros((100, 3), bool)
    failures[:failed, 1] = True
    return values, failures


def test_the_nominal_peak_has_its_percentile_and_the_number_of_failures():
    band = peak_band(NOMINAL, *samples())
    assert (band["frame"], band["failed_samples"]) == (1, 0)
    assert band["nominal_percentile"] == pytest.approx(8.5)
    assert band["median"] == pytest.approx(3.805)
    assert "0 of 100 samples failed" in band["words"]
    assert "outside" not in band["words"]
    band = peak_band(NOMINAL - 0.2, *samples(15))
    assert band["nominal_percentile"] == 0.0
    assert "outside the band" in band["words"]
    assert "15 of 100 samples failed there (15%)" in band["words"]
    band = peak_band(NOMINAL, *samples(60))
    assert (band["median"], band["failed_samples"]) == (None, 60)


def uncertain(failed=0):
    values, failures = samples(failed)
    columns = {
        "time_s": np.arange(3.0),
        "flexion_deg": np.array([10.0, 60.0, 90.0]),
        "force_total_BW": NOMINAL,
        "force_total_N": 700 * NOMINAL,
        "force_si_N": 690 * NOMINAL,
        "status": ["ok"] * 3,
    }
    table = {
        "samples": 100,
        "not_varied": [],
        "largest_failed_share": failed / 100,
        "shares_of_variance": {},
        "peak_force_total_BW": peak_band(NOMINAL, values, failures),
    }
    bands = band_columns(columns["time_s"], ["force_total_BW"], values[:, None], failures)
    return Results(columns, {"uncertainty": table, "body_mass_kg": 70.0}, bands=bands)


@pytest.mark.parametrize("failed", [0, 13, 60])
def test_the_headline_has_median_and_band_or_the_reason_why_not(failed):
    run = uncertain(failed)
    card = {entry.title: entry for entry in cards(run, horizontal_axis(run))}[
        "Peak resultant contact force"
    ]
    uncertainty = SimpleNamespace(results=run, bands=run.bands, tornado=[], indices=[])
    line = next(one for one in headline(uncertainty) if "resultant" in one)
    if failed == 60:
        assert card.value == "3.39 BW"
        assert "no median or band: more than half of the samples failed" in line
    else:
        middle = run.bands["force_total_BW_p50"][1]
        assert card.value.startswith(f"{middle:.2f} BW (")
        assert "3.39 BW with the inputs as given" in card.detail
        assert f"median {middle:.2f} BW, 5 to 95 %" in line
    assert f"{failed} of 100 samples failed" in line


def test_the_width_of_a_tendon_band_is_an_input(tmp_path):
    path = write_scene(tmp_path, drop=("contact",))
    scene = load_scene(path, {"patella.motion": "solved"})
    case = load_case(scene)
    names = [varied.name for varied in varied_inputs(case)]
    assert {"tendon_band.quadriceps", "tendon_band.patellar_ligament"} <= set(names)
    inputs = (VariedInput("tendon_band.quadriceps", 3.0, "mm"),)
    frames = len(case.motion.time)
    for normal, band in ((0.0, 5.0), (2.0, 11.0), (-1.0, 2.0), (-3.0, 0.0)):
        draw = Draw(inputs, np.array([normal]), np.zeros((frames, 0)), 1.0)
        sample = varied_case(case, draw)
        assert sample.muscles[0].wrap.band == pytest.approx(band * 1e-3)
        assert sample.patellar_ligament.wrap.band == case.patellar_ligament.wrap.band
    outlines = [SagittalWrap(band * 1e-3, 3.5e-3).outline(case.femoral, 0.0) for band in (5, 15)]
    assert outlines[1].max() > outlines[0].max() or outlines[1].min() < outlines[0].min()


@pytest.mark.parametrize(("band", "flagged"), [(5.0, False), (15.0, True)])
def test_a_recorded_patella_without_equilibrium_is_flagged(tmp_path, band, flagged):
    scene = write_scene(tmp_path, quadriceps__band_mm=band, contact__resolution_mm=6.0)
    run = simulate(scene, frames=slice(90, 101, 10))
    across = np.abs(run["patellofemoral_tangential_N"])
    assert (across > 100).all() == flagged
    for status in run.status:
        assert ("recorded patella is not in equilibrium with its lines" in status) == flagged


MOVED = ("flexion", "tuberosity.ap", "tuberosity.si", "muscle_attachment.quadriceps.insertion.ap")
MOVED += ("muscle_attachment.quadriceps.origin.si", "tendon_band.quadriceps")
FORCES = ("quadriceps_N", "patellofemoral_N", "patellar_ligament_N", "force_total_N")


def without_contact(path, changes):
    """Return the scene without contact model, with 11 frames and changed keys."""
    scene = load_scene(path, {"motion.frames": 11} | changes)
    return scene.model_copy(update={"contact": None})


def changed_scene(path, values):
    """Return the scene with errors of the inputs `MOVED` (deg, mm), and a solved patella."""
    flexion, forwards, upwards, insertion, origin, band = values
    motion = path.with_name("changed.csv")
    head, *rows = list(csv.reader(path.with_name("motion.csv").read_text().splitlines()))
    at = head.index("flexion_deg")
    for row in rows:
        row[at] = repr(float(row[at]) + flexion)
    motion.write_text("\n".join(map(",".join, [head, *rows])))
    scene = tomllib.loads(path.read_text())
    line, muscle = scene["patellar_ligament"]["distal"], scene["quadriceps"]
    line["point_mm"] = list(np.add(line["point_mm"], [forwards, upwards, 0.0]))
    for end, shift in (("insertion", [insertion, 0, 0]), ("origin", [0, origin, 0])):
        muscle[end]["point_mm"] = list(np.add(muscle[end]["point_mm"], shift))
    changes = {
        "motion.file": motion.name,
        "patellar_ligament.distal": line,
        "quadriceps.insertion": muscle["insertion"],
        "quadriceps.origin": muscle["origin"],
        "quadriceps.band_mm": 5.0 + band,
    }
    return without_contact(path, changes | {"patella.motion": "solved"})


@pytest.mark.parametrize(
    ("motion", "side"), [("recorded", "right"), ("recorded", "left"), ("solved", "right")]
)
def test_samples_of_the_patella_equal_runs_of_changed_scenes(tmp_path, monkeypatch, motion, side):
    """A recorded patella follows its lines: the forces change as those of a solved one."""
    writer = write_scene if side == "right" else write_mirrored_patient
    path = writer(tmp_path)
    scene = without_contact(path, {"patella.motion": motion})
    sampler = Sampler(scene, range(5, 11, 5), FORCES)
    inputs = tuple(VariedInput(name, 1.0, "deg" if name == "flexion" else "mm") for name in MOVED)

    def sample(values):
        frames = len(sampler.case.motion.time)
        draw = Draw(inputs, np.array(values), np.zeros((frames, 1)), 1.0)
        monkeypatch.setattr(sampler, "draw", lambda point: draw)
        return sampler(0, None).values

    def run(values):
        results = simulate(changed_scene(path, values), frames=slice(5, 11, 5))
        return np.array([results[name] for name in FORCES])

    nothing, errors = [0.0] * 6, [0.8, 2.0, -3.0, 3.0, 4.0, 2.0]
    change, expected = sample(errors) - sample(nothing), run(errors) - run(nothing)
    assert np.abs(expected).max() > 100.0
    np.testing.assert_allclose(change, expected, atol=2.0)


def test_a_recorded_patella_has_no_band_where_it_has_no_equilibrium(tmp_path):
    """The change of an equilibrium that does not exist is unknown."""
    path = write_scene(tmp_path, patellar_ligament__length_mm=120.0)
    sampler = Sampler(without_contact(path, {}), range(5, 6), FORCES)
    sample = sampler(0, Point.of(0, np.zeros(len(sampler.inputs))))
    assert sample.problems[0].startswith("patella lost at ")
    assert np.isnan(sample.values).all()


def test_the_summary_compares_the_nominal_peak_with_the_samples(tmp_path):
    scene = write_scene(tmp_path, drop=("contact",))
    uncertainty = estimate_uncertainty(scene, samples=20, frames=slice(60, 101, 20))
    peak = uncertainty.results.summary["uncertainty"]["peak_force_total_BW"]
    assert peak["samples"] == 20
    assert peak["nominal"] == pytest.approx(np.nanmax(uncertainty.results["force_total_BW"]))
    lines = headline(uncertainty)
    assert lines[0].startswith("peak forces: total ")
    assert "total: superior–inferior component" in lines[1]
    assert sum(line.startswith("peak of the resultant total force, at ") for line in lines) == 1
    results = uncertainty.results
    frame = int(np.nanargmax(results["quadriceps_N"]))
    weight = results["force_total_N"][frame] / results["force_total_BW"][frame]
    low, middle, high = results.band("quadriceps_N")[:, frame] / weight
    expected = f"Peak quadriceps tension: {middle:.2f} ({low:.2f}–{high:.2f}) BW"
    assert any(line.startswith(expected) for line in lines)
