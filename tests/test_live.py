"""`tkamb live`: its numbers equal a run of the saved scene, and every input gets an answer."""

import gzip
import json
import shutil
import struct
import time
import urllib.error
import urllib.request
from dataclasses import asdict, replace
from threading import Event

import numpy as np
import pytest

import tkamb
from knee_bodies import whole_body
from mirrored_patient import write_mirrored_patient
from scenes import MODEL, write_scene
from tkamb.cli import main
from tkamb.errors import InputError, TkambError
from tkamb.io.scene.case import load_case
from tkamb.show.view.bench import KEPT_MODELS, MOST_THREADS, BenchRequest, Placement
from tkamb.show.view.live import LiveKnee, setting
from tkamb.show.view.live_window import LiveWindow, bench_of_knee
from tkamb.show.view.show import serve_in_background
from tkamb.studies.designs.design import DESIGN_FILE, FEMORAL_MESH, INSERT_MESH, load_design
from tkamb.studies.designs.solids import write_stl

COARSE = {"contact": "foundation", "resolution_mm": 3.0}


@pytest.fixture(scope="module")
def knee():
    """Return the knee of the shipped scene on the bench."""
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
def test_a_run_of_a_saved_scene_gives_the_same_numbers(knee, name, tmp_path):
    assert_saved_scene_gives_the_same(knee, states(knee)[name], tmp_path / "kept")


def test_the_load_stays_with_the_bone_when_the_insert_is_tilted(knee):
    """The component of the load along the axis of a sloped insert is its cosine."""
    request = replace(states(knee)["pressed"], slack_percent=20.0, tibial=Placement(slope_deg=12.0))
    expected = request.load_N * np.cos(np.radians(12.0))
    assert knee.answer(request).numbers["force_si_N"] == pytest.approx(expected, rel=1e-6)


def test_the_load_stays_with_the_bone_when_the_components_are_moved(knee):
    """If both components move laterally, the line of the load lies medial of their middle."""
    request = replace(states(knee)["pressed"], slack_percent=20.0, flexion_deg=20.0)
    request = replace(request, released=("adduction",), axial_rotation_deg=0.0)
    shifted = {"femoral": Placement(ml_mm=2.0), "tibial": Placement(ml_mm=2.0)}
    before, after = (knee.answer(one).numbers for one in (request, replace(request, **shifted)))
    total = request.load_N
    apart = before["lateral_cop_ml_mm"] - before["medial_cop_ml_mm"]
    moved = (after["medial_force_N"] - before["medial_force_N"]) / total * apart
    assert moved == pytest.approx(2.0, abs=0.1)


def test_a_saved_scene_keeps_material_ankle_force_and_yield_stress(tmp_path):
    changes = {
        "contact__material": None,
        "ground_reaction__applied": "ankle",
        "material": {"base": "polyethylene", "young_modulus_MPa": 900.0, "name": "stiff PE"},
        "output__yield_stress_MPa": 15.0,
    }
    scene = tkamb.load_scene(write_scene(tmp_path / "scene", **changes))
    other = LiveKnee(load_case(scene))
    request = replace(other.recorded(60), resolution_mm=3.0)
    assert_saved_scene_gives_the_same(other, request, tmp_path / "kept")
    saved = tkamb.load_scene(tmp_path / "kept" / "scene.toml")
    assert saved.material == scene.material
    assert saved.yield_stress_MPa == 15.0


def test_a_scene_with_only_knee_coordinates_carries_the_load(tmp_path):
    drop = ("tibia", "ground_reaction", "patella", "quadriceps", "patellar_ligament")
    bare = LiveKnee(load_case(tkamb.load_scene(write_scene(tmp_path / "scene", drop))))
    request = replace(bare.recorded(60), **COARSE, slack_percent=20.0)
    assert bare.answer(request).numbers["force_si_N"] == pytest.approx(request.load_N, rel=1e-9)
    assert_saved_scene_gives_the_same(bare, request, tmp_path / "kept")


def test_the_thickness_of_a_parametric_insert_changes_and_is_saved(tmp_path):
    design = load_design(MODEL.parent / "designs" / "cr_flex")
    design.write_meshes(tmp_path)
    shutil.copy(MODEL.parent / "designs" / "cr_flex" / DESIGN_FILE, tmp_path)
    meshes = {"femoral": FEMORAL_MESH, "insert": INSERT_MESH}
    changes = {f"implant.{part}.mesh": str(tmp_path / name) for part, name in meshes.items()}
    case = load_case(tkamb.load_scene(MODEL / "scene.toml", changes))
    parametric = LiveKnee(case)
    thin = replace(parametric.recorded(60), **COARSE)
    thick = replace(thin, thickness_mm=thin.thickness_mm + 2.5)
    before, after = parametric.answer(thin), parametric.answer(thick)
    # the dishes lift the femur, so the ligaments stretch
    assert 1e3 * (after.pose[1, 3] - before.pose[1, 3]) == pytest.approx(2.5, abs=0.1)
    strains = [name for name in before.numbers if name.endswith("strain_percent")]
    assert all(after.numbers[name] > before.numbers[name] for name in strains)
    assert_saved_scene_gives_the_same(parametric, thick, tmp_path / "kept")

    write_stl(tmp_path / INSERT_MESH, *replace(design.insert, dish_half=22.5).mesh())
    other = LiveKnee(load_case(case.scene))
    assert other.design is None  # the design beside the mesh does not reproduce it
    with pytest.raises(InputError, match="parametric"):
        other.answer(replace(thick, thickness_mm=8.0))


@pytest.fixture(scope="module")
def plain():
    """Return the knee of the shipped scene as an object, and the state of one frame."""
    changes = {"contact.model": "foundation", "contact.resolution_mm": 3.0}
    plain, motion, ground = tkamb.read_scene(tkamb.load_scene(MODEL / "scene.toml", changes))
    return plain, (motion.q[60], motion.v[60], motion.a[60], ground[60])


def test_a_knee_object_gives_the_same_numbers_as_press(plain, tmp_path):
    plain_knee, state = plain
    bench = bench_of_knee(plain_knee, state[0])
    request = replace(bench.recorded(0), load_N=900.0)
    slack, pressed = (
        bench.answer(replace(request, slack_percent=20.0)),
        plain_knee.press(state[0], 900.0),
    )
    for side in ("medial", "lateral"):
        condyle = getattr(pressed, side)
        assert slack.numbers[f"{side}_force_N"] == pytest.approx(condyle.force, rel=1e-6)
        peak = slack.numbers[f"{side}_peak_pressure_MPa"]
        assert 1e6 * peak == pytest.approx(condyle.peak_pressure, rel=1e-6)
    assert_saved_scene_gives_the_same(bench, request, tmp_path / "kept")


def test_a_left_knee_object_is_the_mirror_image(plain, tmp_path):
    plain_knee, state = plain
    body = whole_body(plain_knee, True, False)
    left = bench_of_knee(body.knee, body.state(*state)[0])
    right = bench_of_knee(plain_knee, state[0])
    request = replace(right.recorded(0), load_N=900.0, tibial=Placement(ml_mm=1.0))
    places = left.recorded(0).coordinates(), right.recorded(0).coordinates()
    assert places[0] == pytest.approx(places[1], abs=1e-9)
    expected, numbers = right.answer(request).numbers, left.answer(request).numbers
    assert numbers == pytest.approx(expected, rel=1e-5, abs=1e-5)
    assert left.case.scene.patient.side == "left"
    assert_saved_scene_gives_the_same(left, request, tmp_path / "kept")


def test_a_knee_object_needs_a_contact_model_with_a_name(plain):
    plain_knee, state = plain
    bare = tkamb.Knee(plain_knee.model)
    with pytest.raises(InputError, match="contact"):
        tkamb.live(bare, state[0])

    class Nameless(type(plain_knee.contact.model)):
        pass

    nameless = tkamb.Knee(
        plain_knee.model, implant=plain_knee.implant, contact=Nameless(resolution=3e-3)
    )
    with pytest.raises(InputError, match="Nameless"):
        tkamb.live(nameless, state[0])


def test_a_saved_state_is_computed_without_an_initial_guess(knee, tmp_path):
    """The initial guess changes the answer of a lattice within its tolerance."""
    window = LiveWindow(knee, tmp_path, 60)
    request = replace(knee.recorded(60), contact="lattice", resolution_mm=4.0)
    for flexion in (50.0, 58.0, 60.0):
        knee.answer(replace(request, flexion_deg=flexion))
    saved = words(window.question("save", asdict(request)))
    results = tkamb.simulate(saved["saved"], frames=slice(0, 1))
    for name in ("force_si_N", "medial_force_N", "medial_peak_pressure_MPa", "approach_mm"):
        assert results[name][0] == pytest.approx(saved["numbers"][name], rel=1e-9)


def words(packed):
    """Return the JSON object in a packed answer."""
    content = gzip.decompress(packed)
    (size,) = struct.unpack("<I", content[:4])
    return json.loads(json.loads(content[4 : 4 + size])["words"])


def test_a_left_knee_is_saved_as_a_left_knee(tmp_path):
    left = LiveKnee(load_case(tkamb.load_scene(write_mirrored_patient(tmp_path / "left"))))
    request = replace(left.recorded(60), **COARSE, ml_mm=1.0, tibial=Placement(ml_mm=0.5))
    assert_saved_scene_gives_the_same(left, request, tmp_path / "kept")


def test_taut_ligaments_increase_the_contact_force(knee):
    """Without tension in the ligaments the contact force equals the axial load."""
    request = states(knee)["pressed"]
    slack = knee.answer(replace(request, slack_percent=20.0))
    assert slack.numbers["force_si_N"] == pytest.approx(request.load_N, abs=1.0)
    assert knee.answer(request).numbers["force_si_N"] > request.load_N + 10.0


def test_the_same_shift_of_both_components_changes_no_contact_force(knee):
    request = replace(states(knee)["pressed"], slack_percent=20.0, flexion_deg=0.0)
    request = replace(request, adduction_deg=0.0, axial_rotation_deg=0.0)
    shifted = {"femoral": Placement(ap_mm=3.0), "tibial": Placement(ap_mm=3.0)}
    before, after = knee.answer(request), knee.answer(replace(request, **shifted))
    assert after.numbers["medial_force_N"] == pytest.approx(
        before.numbers["medial_force_N"], rel=1e-6
    )


def test_a_newer_request_cancels_an_older_one(knee):
    stale = knee.overtake()
    knee.overtake()
    with pytest.raises(TkambError, match="overtaken"):
        knee.answer(states(knee)["pressed"], stale)


def test_every_random_state_has_a_status(knee):
    """The states include lift-off, edge contact, dislocation and five body weights."""
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
def test_invalid_requests_of_the_page_are_refused(values):
    with pytest.raises(InputError):
        BenchRequest.read(values)


def test_the_window_answers_only_its_own_page(knee, tmp_path):
    server = LiveWindow(knee, tmp_path, 60).server()
    knee.answer(states(knee)["pressed"])  # prepares the contact model
    serve_in_background(server)
    try:
        with urllib.request.urlopen(server.url, timeout=30) as page:
            assert b"live.js" not in page.read() and page.status == 200
        content = json.dumps(asdict(states(knee)["pressed"])).encode()
        foreign = urllib.request.Request(server.url.rsplit("/", 2)[0] + "/live", content)
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(foreign, timeout=30)
        with urllib.request.urlopen(
            urllib.request.Request(server.url + "save", content), timeout=60
        ) as saved:
            assert (tmp_path / "kept-1" / "scene.toml").samefile(words(saved.read())["saved"])
    finally:
        server.close()


def test_an_unexpected_error_in_a_preparation_reaches_the_page(knee, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(knee, "_recording", lambda request: 1 / 0)
    request = replace(states(knee)["pressed"], resolution_mm=7.0)
    with pytest.raises(TkambError, match="unexpected error: ZeroDivisionError"):
        list(iter(lambda: knee.preparing(request), ""))


def test_few_models_are_prepared_at_a_time_and_the_oldest_are_deleted(monkeypatch):
    bench = LiveKnee(load_case(tkamb.load_scene(MODEL / "scene.toml")))
    go_on, begun = Event(), []

    def slow(request):
        begun.append(request.resolution_mm)
        assert go_on.wait(60.0)
        bench._recordings[setting(request)] = None
        with bench._counting:
            bench._forget()

    monkeypatch.setattr(bench, "_recording", slow)
    requests = [replace(bench.recorded(60), resolution_mm=1.0 + 0.1 * k) for k in range(12)]
    for request in requests:
        assert bench.preparing(request)
    assert len(bench._threads) == MOST_THREADS == len(begun)
    assert "then" in bench.preparing(requests[-1])
    go_on.set()
    for request in requests[2:]:
        while bench.preparing(request):
            time.sleep(0.005)
    assert not bench._threads
    assert [*bench._recordings] == [setting(one) for one in requests[-KEPT_MODELS:]]


def test_an_insert_is_deleted_with_the_last_model_that_needs_it(knee):
    bench = LiveKnee(knee.case)
    bench._cases = dict.fromkeys((8.0, 9.0))
    bench._shared = dict.fromkeys((8.0, 9.0))
    bench._recordings = {("foundation", 2.0, 9.0): None}
    bench._forget()
    assert [*bench._cases] == [*bench._shared] == [9.0]


def test_a_scene_without_contact_is_refused(tmp_path, capfd):
    assert main(["live", str(write_scene(tmp_path, ("contact",)))]) == 2
    assert "[contact]" in capfd.readouterr().err
