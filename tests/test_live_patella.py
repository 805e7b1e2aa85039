"""The released patella in `tkamb live`: the equilibrium of the object, moved components, losses."""

import gzip
import json
import struct
from dataclasses import asdict, replace

import numpy as np
import pinocchio as pin
import pytest

import tkamb
from headless import Page
from knee_bodies import whole_body
from patella_bodies import body_knee
from released_patella import RELEASED
from scenes import write_scene
from tkamb.errors import InputError
from tkamb.geometry.frames import inverse, transform
from tkamb.io.scene.case import load_case
from tkamb.show.view.bench import BenchRequest, Placement
from tkamb.show.view.live import LiveKnee
from tkamb.show.view.live_window import LiveWindow, bench_of_knee

BUTTON = {"model": "foundation", "resolution_mm": 1.0}
COARSE = {"contact": "foundation", "resolution_mm": 3.0}
STATES = [(10, 300.0), (45, 735.0), (60, 2000.0), (95, 3500.0)]


def scene_of(folder, ligaments=RELEASED["ligament"], **changes):
    return write_scene(
        folder,
        contact__patellofemoral=BUTTON,
        patella=RELEASED | {"ligament": ligaments},
        **changes,
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return scene_of(tmp_path_factory.mktemp("live"))


@pytest.fixture(scope="module")
def source(scene):
    """Return knee and motion of the scene."""
    return tkamb.read_scene(scene)[:2]


@pytest.fixture(scope="module")
def live(scene):
    return LiveKnee(load_case(tkamb.load_scene(scene)))


def assert_numbers(numbers, found, facets=True):
    """Compare the numbers of the page with a result of `Knee.patella_equilibrium`."""
    assert not found.failed
    assert numbers["patella_tilt_deg"] == pytest.approx(
        np.degrees(found.coordinates["tilt"]), abs=1e-6
    )
    assert numbers["patella_shift_mm"] == pytest.approx(1e3 * found.coordinates["shift"], abs=1e-6)
    contact = found.contact.contact
    force = np.linalg.norm(contact.wrench_on_insert[:3])
    assert numbers["button_force_N"] == pytest.approx(force, rel=1e-6)
    halves = {side: getattr(contact, side) for side in ("medial", "lateral")}
    for side, facet in halves.items() if facets else ():
        expected = 0.0 if facet is None else facet.force
        assert numbers[f"button_{side}_force_N"] == pytest.approx(expected, rel=1e-5, abs=1e-6)
    area = sum(facet.area for facet in halves.values() if facet)
    assert numbers["button_area_mm2"] == pytest.approx(1e6 * area, rel=1e-5)
    peak = contact.pressure.max()
    assert 1e6 * numbers["button_peak_pressure_MPa"] == pytest.approx(peak, rel=1e-5)


@pytest.mark.parametrize(("frame", "tension"), STATES)
def test_the_page_has_the_equilibrium_of_the_object(live, source, frame, tension):
    """The states follow each other, each with the one before as guess; the object starts anew."""
    knee, motion = source
    request = replace(live.recorded(frame), **COARSE, axial_rotation_deg=3.0, quadriceps_N=tension)
    answer = live.answer(request)
    q = knee.bridge.configuration(motion.q[frame], answer.pose)
    found = knee.patella_equilibrium(q, tension)
    assert_numbers(answer.numbers, found)
    assert answer.patella.map.pressure[0] * 1e6 == pytest.approx(
        found.contact.contact.pressure, abs=10.0
    )
    drawn = inverse(answer.pose) @ answer.patella.pose
    assert drawn == pytest.approx(found.pose.homogeneous, abs=1e-8)


@pytest.mark.parametrize("left", [False, True])
def test_a_knee_object_has_the_same_patella_on_both_sides(source, left, tmp_path):
    """The patella of the whole body's model is its own, and its insert has other axes."""
    plain, motion = source
    made = body_knee(plain, released=True, contact=plain.contact)
    body = whole_body(made, left, False)
    still = [np.zeros(plain.model.nv)] * 2
    none = [pin.Force.Zero() for _ in range(plain.model.njoints)]
    q = body.state(motion.q[60], *still, none)[0]
    bench = bench_of_knee(body.knee, q)
    answer = bench.answer(replace(bench.recorded(0), quadriceps_N=1200.0))
    pressed = body.knee.bridge.configuration(q, inverse(bench.patella._placement) @ answer.pose)
    found = body.knee.patella_equilibrium(pressed, 1200.0)
    assert_numbers(answer.numbers, found)


def test_a_moved_femoral_component_is_that_of_a_scene_with_a_moved_mesh(tmp_path):
    """1.5 mm lateral and 3 deg internal on the bone. The heads are straight: no outline moves.

    The plane between the facets moves with the component, that of the scene stays with the bone.
    """
    straight = {"quadriceps__wrap": False}
    bench = LiveKnee(load_case(tkamb.load_scene(scene_of(tmp_path / "straight", **straight))))
    start = replace(bench.recorded(60), **COARSE, quadriceps_N=1500.0)
    moved = Placement(ml_mm=1.5, rotation_deg=-3.0)
    answer = bench.answer(replace(start, femoral=moved))
    mesh = {"implant__femoral__position_mm": [0.0, 0.0, 1.5]}
    mesh["implant__femoral__rotation_deg"] = [0.0, 3.0, 0.0]
    knee, motion, _ = tkamb.read_scene(scene_of(tmp_path / "moved", **straight, **mesh))
    bone = answer.pose @ inverse(moved.matrix())
    found = knee.patella_equilibrium(knee.bridge.configuration(motion.q[60], bone), 1500.0)
    assert_numbers(answer.numbers, found, facets=False)
    before = bench.answer(start).numbers
    for name in ("patella_shift_mm", "patella_tilt_deg"):
        assert abs(answer.numbers[name] - before[name]) > 0.1


def test_an_insert_moved_on_the_bone_keeps_the_tuberosity_on_the_bone(live, source):
    """The insert moves 3 mm medial, so the tuberosity lies 3 mm lateral in the insert frame."""
    knee, motion = source
    request = replace(live.recorded(30), **COARSE, quadriceps_N=1500.0)
    answer = live.answer(replace(request, tibial=Placement(ml_mm=-3.0)))
    q = knee.bridge.configuration(motion.q[30], answer.pose)
    strands = [
        replace(one, distal=replace(one.distal, position=np.add(one.distal.position, [0, 0, 3e-3])))
        for one in knee.patella.lines
        if one.distal.link == "tibia"
    ]
    retinacula = [one for one in knee.patella.lines if "tibia" not in one.links]
    assert (len(strands), len(retinacula)) == (2, 2)
    changed = knee._with_patella(replace(knee.patella, lines=(*strands, *retinacula)))
    assert_numbers(answer.numbers, changed.patella_equilibrium(q, 1500.0))
    # Femur and tibia keep their places, so the patella does too.
    before = live.answer(request).numbers
    for name in ("patella_tilt_deg", "patella_rotation_deg"):
        assert answer.numbers[name] == pytest.approx(before[name], abs=0.05)
    assert knee.patella_equilibrium(q, 1500.0).coordinates["rotation"] != pytest.approx(
        np.radians(before["patella_rotation_deg"]), abs=np.radians(0.5)
    )


def test_a_state_saved_from_rest_has_the_same_patella(live):
    request = replace(live.recorded(70), **COARSE, quadriceps_N=900.0)
    live.answer(replace(request, flexion_deg=60.0))
    warm, cold = live.answer(request), live.answer(request, from_rest=True)
    for name in ("patella_tilt_deg", "button_force_N", "button_peak_pressure_MPa"):
        assert warm.numbers[name] == pytest.approx(cold.numbers[name], rel=1e-6)


def assert_no_patella(answer, words):
    """The knee has its numbers, the patella has words and no number, and nothing is drawn."""
    assert words in answer.status and not answer.failed
    assert np.isfinite(answer.numbers["medial_force_N"])
    names = [name for name in answer.numbers if name.startswith(("button_", "patella_"))]
    assert len(names) > 10 and np.isnan([answer.numbers[name] for name in names]).all()
    assert np.isnan(answer.patella.pose).all() and not answer.patella.map.pressure.any()
    assert all(np.isnan(one.points).all() for one in answer.patella.strands)


def test_without_tension_the_patella_is_slack(live):
    request = replace(live.recorded(60), **COARSE, quadriceps_N=0.0)
    assert_no_patella(live.answer(request), "patella: slack, because the quadriceps does not pull")


def bench_with_strands(folder, slack):
    """Return the bench with strands of the patellar ligament of a slack length, mm."""
    strands = [one | {"slack_length_mm": slack} for one in RELEASED["ligament"][:2]]
    lines = [*strands, *RELEASED["ligament"][2:]]
    return LiveKnee(load_case(tkamb.load_scene(scene_of(folder, lines))))


def test_a_lost_patella_has_words_and_no_numbers(tmp_path):
    """With strands 20 mm longer the quadriceps pulls the button off the flange in extension."""
    bench = bench_with_strands(tmp_path, 70.0)
    answer = bench.answer(replace(bench.recorded(0), **COARSE, quadriceps_N=500.0))
    assert_no_patella(answer, "patella: the released coordinates run away")


def test_a_patella_at_the_edge_of_the_flange_has_a_flag(tmp_path):
    """Strands 17 mm longer: in extension the contact is at the upper edge of the flange."""
    bench = bench_with_strands(tmp_path, 67.0)
    answer = bench.answer(replace(bench.recorded(0), **COARSE, quadriceps_N=500.0))
    assert "the button leaves the flange" in answer.status
    assert answer.numbers["button_force_N"] > 0.0


def test_strands_without_tension_do_not_carry_the_patella(live):
    """At 10 deg of hyperextension and 20 N the retinacula alone hold it."""
    request = replace(live.recorded(0), **COARSE, flexion_deg=-10.0, quadriceps_N=20.0)
    assert_no_patella(live.answer(request), "patella: no ligament to the tibia is taut")


def test_the_patella_changes_no_number_of_the_knee(live, tmp_path):
    plane = LiveKnee(load_case(tkamb.load_scene(write_scene(tmp_path / "plane"))))
    assert plane.patella is None and plane.recorded(40).quadriceps_N is None
    request = live.recorded(40)
    assert request.quadriceps_N == pytest.approx(live.case.body_weight)
    mine, other = live.answer(request), plane.answer(plane.recorded(40))
    for name, value in other.numbers.items():
        assert mine.numbers[name] == pytest.approx(value, rel=1e-9, nan_ok=True), name
    with pytest.raises(InputError, match="no released patella"):
        plane.answer(replace(plane.recorded(40), quadriceps_N=500.0))
    results = tkamb.simulate(live.save(request, tmp_path / "kept"))
    assert not any(name.startswith("button") for name in results.columns)


def test_configurations_without_a_patella_are_refused(source):
    knee, motion = source
    q = motion.q[60].copy()
    q[list(knee.anatomy.patella_q)] = np.nan
    with pytest.raises(InputError, match="no pose of the patella"):
        bench_of_knee(knee, q)


def unpacked(packed):
    """Return the words of a packed answer, and the levels of the button's map."""
    content = gzip.decompress(packed)
    (size,) = struct.unpack("<I", content[:4])
    header, arrays = json.loads(content[4 : 4 + size]), content[4 + size :]
    span = header["button_map"]["levels"]
    return json.loads(header["words"]), np.frombuffer(arrays, np.int16, span["n"], span["at"])


def test_the_page_gets_one_scale_and_a_button_on_the_femur(live, tmp_path):
    window = LiveWindow(live, tmp_path, 60)
    request = replace(live.recorded(60), **COARSE, quadriceps_N=4000.0, load_N=100.0)
    words, levels = unpacked(window.question("live", asdict(request)))
    numbers = words["numbers"]
    assert numbers["button_peak_pressure_MPa"] > numbers["medial_peak_pressure_MPa"]
    shown = levels.max() / 32767 * words["scale_MPa"]
    assert shown == pytest.approx(numbers["button_peak_pressure_MPa"], rel=1e-3)
    poses = {name: np.reshape(pose, (4, 4)).T for name, pose in words["poses"].items()}
    points = transform(poses["pressure map/button"], live.patella.hidden.map.points[levels > 0])
    femoral = poses["femoral component/femoral component"]
    nearest = live.case.femoral.nearest.at(transform(inverse(femoral), points))
    assert nearest.distance.max() < 1.5e-3
    for name in ("strand medial", "lateral"):
        assert np.isfinite(words["strands"][name]["points"]).all()
    words, levels = unpacked(window.question("live", asdict(replace(request, quadriceps_N=0.0))))
    assert words["poses"]["patella/patella"] is None and not (levels > 0).any()
    assert not any(name.startswith("button_") for name in words["numbers"])


def test_tensions_out_of_range_are_refused():
    for value in (-1.0, 1e5, "much", float("nan")):
        with pytest.raises(InputError, match="quadriceps_N"):
            BenchRequest.read({"quadriceps_N": value})


def test_a_key_changes_the_tension_and_the_page_shows_the_patella(chromium, scene, tmp_path):
    server = tkamb.live(scene, frame=60, quadriceps=1500.0, folder=tmp_path)
    page = Page(chromium).open(server.url)
    idle = "!tkamb.bench.busy && !tkamb.bench.waiting && !tkamb.bench.timer"
    page.wait(f"{idle} && tkamb.bench.reference")
    page.evaluate("() => document.getElementById('pose-quadriceps_N').focus()")
    page.press("ArrowRight")
    page.wait(f"{idle} && tkamb.bench.answer.request.quadriceps_N === 1510")
    peak = page.evaluate("() => tkamb.bench.answer.numbers.button_peak_pressure_MPa")
    cell = "() => document.querySelector('[data-name=button_peak_pressure_MPa]').textContent"
    assert page.evaluate(cell) == f"{peak:.1f}"
    level = """() => Math.max(...tkamb.node('/tkamb/0/pressure map/button/<object>')
      .object.geometry.attributes.level.array)"""
    scale = page.evaluate("() => tkamb.data.peak_MPa")
    assert scale * page.evaluate(level) == pytest.approx(peak, rel=1e-3)
    # The camera lies on the button's axis, and stays there while the knee flexes.
    page.evaluate("() => tkamb.look('button')")
    page.evaluate("() => tkamb.bench.change('pose', 'flexion_deg', 100, false)")
    page.wait(f"{idle} && tkamb.bench.answer.request.flexion_deg === 100")
    camera, button = (np.array(page.evaluate(one)) for one in (
        "() => tkamb.viewer.camera.position.toArray()",
        "() => tkamb.node('/tkamb/0/pressure map/button').object.matrixWorld.elements.slice(4)",
    ))  # fmt: skip
    way = camera - button[8:11]
    assert way / np.linalg.norm(way) == pytest.approx(button[:3], abs=1e-6)
    page.evaluate("() => tkamb.bench.change('pose', 'quadriceps_N', 0, false)")
    page.wait(f"{idle} && tkamb.bench.answer.request.quadriceps_N === 0")
    assert "slack" in page.evaluate("() => document.getElementById('status').textContent")
    assert page.evaluate(cell) == "\u2013"
    shown = "(name) => tkamb.node(`/tkamb/0/${name}`).object.visible"
    for name in ("patella/patella", "pressure map/button", "extensor lines/lateral"):
        assert not page.evaluate(shown, name)
    assert page.problems == []
    page.close()
    server.close()
