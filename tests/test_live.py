"""`tkamb live`: what it shows is what a run of the saved scene gives, whatever a hand does."""

import json
import urllib.error
import urllib.request
from dataclasses import asdict, replace

import numpy as np
import pytest

import tkamb
from mirrored_patient import write_mirrored_patient
from scenes import MODEL
from tkamb.cli import main
from tkamb.errors import InputError, TkambError
from tkamb.io.scene.case import load_case
from tkamb.show.view.bench import BenchRequest, Placement
from tkamb.show.view.live import LiveKnee
from tkamb.show.view.live_window import LiveWindow
from tkamb.show.view.show import serve_in_background

COARSE = {"contact": "foundation", "resolution_mm": 3.0}


@pytest.fixture(scope="module")
def knee():
    """Return the shipped knee on the bench."""
    return LiveKnee(load_case(tkamb.load_scene(MODEL / "scene.toml")))


def states(knee):
    """Return some states of the bench by name."""
    start = replace(knee.recorded(60), **COARSE)
    moved = {"femoral": Placement(varus_deg=1.0, ap_mm=1.0), "tibial": Placement(slope_deg=3.0)}
    return {
        "pressed": start,
        "heavy": replace(start, load_N=3000.0, flexion_deg=30.0),
        "placed": replace(start, **moved, slack_percent=-2.0),
        "released": replace(start, released=("ap", "si", "ml", "axial_rotation", "adduction")),
    }


def assert_saved_scene_gives_the_same(knee, request, folder):
    answer = knee.answer(request)
    assert not answer.failed
    results = tkamb.simulate(knee.save(request, folder), frames=slice(0, 1))
    compared = [name for name in answer.numbers if name in results.columns]
    assert {"force_si_N", "medial_force_N", "medial_peak_pressure_MPa"} <= set(compared)
    for name in compared:
        largest = max(abs(answer.numbers[name]), 1.0)
        assert abs(results[name][0] - answer.numbers[name]) <= 1e-6 * largest, name


@pytest.mark.parametrize("name", ["pressed", "heavy", "placed", "released"])
def test_a_saved_scene_runs_to_the_same_numbers(knee, name, tmp_path):
    assert_saved_scene_gives_the_same(knee, states(knee)[name], tmp_path / "kept")


def test_a_left_knee_is_saved_as_a_left_one(tmp_path):
    left = LiveKnee(load_case(tkamb.load_scene(write_mirrored_patient(tmp_path / "left"))))
    request = replace(left.recorded(60), **COARSE, ml_mm=1.0, tibial=Placement(ml_mm=0.5))
    assert_saved_scene_gives_the_same(left, request, tmp_path / "kept")


def test_the_load_is_what_the_condyles_and_ligaments_carry(knee):
    """Without ligaments the contact carries the axial load; with them more."""
    request = states(knee)["pressed"]
    slack = knee.answer(replace(request, slack_percent=20.0))
    assert slack.numbers["force_si_N"] == pytest.approx(request.load_N, abs=1.0)
    assert knee.answer(request).numbers["force_si_N"] > request.load_N + 10.0


def test_moving_both_components_alike_is_no_change(knee):
    """Femoral component and insert shifted forwards alike: ligaments alone feel it."""
    request = replace(states(knee)["pressed"], slack_percent=20.0, flexion_deg=0.0)
    request = replace(request, adduction_deg=0.0, axial_rotation_deg=0.0)
    both = {"femoral": Placement(ap_mm=3.0), "tibial": Placement(ap_mm=3.0)}
    before, after = knee.answer(request), knee.answer(replace(request, **both))
    assert after.numbers["medial_force_N"] == pytest.approx(
        before.numbers["medial_force_N"], rel=1e-6
    )


def test_an_overtaken_request_is_dropped(knee):
    stale = knee.overtake()
    knee.overtake()
    with pytest.raises(TkambError, match="overtaken"):
        knee.answer(states(knee)["pressed"], stale)


def test_no_hand_breaks_it(knee):
    """Lift-off, edges, a dislocated femur, one condyle, five body weights: a status, always."""
    chance, statuses = np.random.default_rng(7), set()
    for _ in range(60):
        angles, lengths = chance.uniform(-1, 1, 3), chance.uniform(-1, 1, 2)
        request = BenchRequest(
            flexion_deg=70 + 90 * angles[0],
            adduction_deg=10 * angles[1],
            axial_rotation_deg=40 * angles[2],
            ap_mm=50 * lengths[0],
            ml_mm=40 * lengths[1],
            load_N=chance.choice([0.0, 1.0, 800.0, 3700.0]),
            femoral=Placement(varus_deg=8 * chance.uniform(-1, 1)),
            slack_percent=10 * chance.uniform(-1, 1),
            **COARSE,
        )
        answer = knee.answer(request)
        statuses.add(answer.status.split(":")[0])
        assert answer.status
        if answer.failed:
            assert not answer.numbers
        else:
            assert np.isfinite(list(answer.numbers.values())).all()
    assert len(statuses) > 2


@pytest.mark.parametrize(
    "values",
    [
        {"flexion_deg": "much"},
        {"load_N": -1},
        {"load_N": float("nan")},
        {"unknown": 1},
        {"femoral": {"ap_mm": 100}},
        {"released": ["flexion"]},
        {"flexion_deg": True},
        {"resolution_mm": 0.001},
        {"load_N": 10**400},
        {"femoral": {"slope_deg": -(10**400)}},
        {"released": [["ap"]]},
        {"released": [{}, "ap"]},
    ],
)
def test_a_page_cannot_ask_for_nonsense(values):
    with pytest.raises(InputError):
        BenchRequest.read(values)


def test_the_window_answers_its_own_page_only(knee, tmp_path):
    server = LiveWindow(knee, tmp_path, 60).server()
    serve_in_background(server)
    try:
        with urllib.request.urlopen(server.url, timeout=30) as page:
            assert b"live.js" not in page.read() and page.status == 200
        question = json.dumps(asdict(states(knee)["pressed"])).encode()
        foreign = urllib.request.Request(server.url.rsplit("/", 2)[0] + "/live", question)
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(foreign, timeout=30)
        with urllib.request.urlopen(
            urllib.request.Request(server.url + "save", question), timeout=60
        ) as saved:
            assert (tmp_path / "kept-1" / "scene.toml").samefile(saved.read().decode())
    finally:
        server.close()


def test_what_nobody_foresaw_of_a_preparation_is_said_to_the_page(knee, monkeypatch, tmp_path):
    """The thread ended with a traceback, and the page waited for ever."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(knee, "_side", lambda request: 1 / 0)
    request = replace(states(knee)["pressed"], resolution_mm=7.0)
    with pytest.raises(TkambError, match="not foreseen: ZeroDivisionError"):
        list(iter(lambda: knee.preparing(request), ""))


def test_a_scene_without_contact_is_refused(tmp_path, capfd):
    from scenes import write_scene

    assert main(["live", str(write_scene(tmp_path, ("contact",)))]) == 2
    assert "[contact]" in capfd.readouterr().err
