"""Force control of the virtual simulator: rest where it is known, and what it does to a cycle."""

import json
from dataclasses import replace

import numpy as np
import pytest

import shapes
from contact_bodies import dished_insert, flat_insert, graded_sphere
from tkamb.cli import main
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.errors import InputError
from tkamb.geometry.frames import knee_coordinates, knee_pose
from tkamb.studies.wear import run as wear_run
from tkamb.studies.wear.engine import ContactEngine
from tkamb.studies.wear.laws import Archard
from tkamb.studies.wear.motion import CycleMotion
from tkamb.studies.wear.simulation import WearCase, simulate_wear
from tkamb.studies.wear.simulator import (
    EquilibriumPoses,
    ForceDrive,
    Spring,
    Springs,
    read_profile,
    read_springs,
    zero_at,
)
from tkamb.studies.wear.worn_surface import ArticularSurface
from wear_bodies import DENSITY, MM, balls, balls_scene

AP, SI, ML, TURN = 0, 1, 2, 3
CYCLE = """cycle_percent,axial_force_N,flexion_deg,ap_force_N,axial_torque_Nm
0,300,0,0,0
25,1500,15,-60,1
50,1200,8,40,2
75,400,50,-20,-1
100,300,0,0,0
"""
SPRINGS = """sources = ["made up for a test"]
[ap]
stiffness_N_per_mm = 30.0
gap_mm = 0.5
[axial_rotation]
stiffness_Nm_per_deg = 0.4
gap_deg = 1.0
"""


def machine(applied, free, springs=None):
    """A drive of (f, 6) forces at coordinates that begin at zero."""
    applied = np.atleast_2d(np.asarray(applied, float))
    held = springs and Springs(springs, ("test",), {})
    return ForceDrive(np.zeros_like(applied), applied, free, np.zeros(6), held)


def rest(insert, femoral, drive, load, resolution=2.0):
    """Return the coordinates (6,) at which a drive's first row rests, and what stops it."""
    model = contact_model("foundation", resolution)
    pair = ContactPair(femoral, insert, material("polyethylene-linear"))
    pose, why = EquilibriumPoses(model, model.prepare(pair), drive).at(0, load, None)
    return knee_coordinates(pose), why


def ball():
    return shapes.sphere(25 * MM, 3)


def dish(radius, depth=10 * MM, spacing=0.5 * MM):
    def height(x, z):
        return depth + radius - np.sqrt(radius**2 - x**2 - z**2)

    return dished_insert(height, 16 * MM, 16 * MM, spacing)


@pytest.mark.parametrize("share", [0.15, pytest.param(-0.05, marks=pytest.mark.slow)])
def test_a_ball_in_a_dish_rests_where_the_normal_lies_along_the_resultant(share):
    """tan = P/F about the dish's centre: both bodies are symmetric about the line of centres."""
    load, radius = 800.0, 40 * MM
    applied = [share * load, -load, 0, 0, 0, 0]
    drive = machine(applied, (AP, SI))
    found, why = rest(dish(radius), graded_sphere(25 * MM), drive, load, 1.0)
    assert not why
    # the bed is thicker up the slope, by half a per cent of stiffness over the contact
    assert found[AP] / (10 * MM + radius - found[SI]) == pytest.approx(share, rel=0.01)


@pytest.mark.parametrize(("force", "gap"), [(60.0, 0.0), (-45.0, 0.7 * MM)])
def test_on_a_flat_plate_a_spring_with_a_gap_carries_the_ap_force(force, gap):
    drive = machine([force, -500.0, 0, 0, 0, 0], (AP, SI), {"ap": Spring(30e3, gap)})
    found, why = rest(flat_insert(10 * MM), ball(), drive, 500.0)
    assert not why
    assert found[AP] == pytest.approx(np.sign(force) * (abs(force) / 30e3 + gap), abs=2e-6)


@pytest.mark.parametrize(("torque", "gap"), [(-2.0, np.radians(2.5))])
def test_on_a_flat_plate_a_spring_with_a_gap_carries_the_axial_torque(torque, gap):
    stiffness = np.degrees(0.4)  # 0.4 N·m/deg
    applied = [0, -900.0, 0, torque, 0, 0]
    drive = machine(applied, (SI, TURN), {"axial_rotation": Spring(stiffness, gap)})
    plate = flat_insert(10 * MM, 15 * MM, 34 * MM)
    found, why = rest(plate, balls(), drive, 900.0)
    assert not why
    turned = np.sign(torque) * (abs(torque) / stiffness + gap)
    assert found[TURN] == pytest.approx(turned, abs=1e-4)


def test_a_force_that_nothing_holds_is_no_pose():
    drive = machine([60.0, -500.0, 0, 0, 0, 0], (AP, SI))
    _, why = rest(flat_insert(10 * MM), ball(), drive, 500.0)
    assert "no equilibrium" in why or "search begins" in why


def test_the_dwell_position_is_where_the_ball_lies_deepest():
    """A ball over a dish whose bottom lies ahead and to the left; the profile's zero is there."""
    bottom = (6 * MM, -3 * MM)

    def height(x, z):
        return 10 * MM + 8.0 * ((x - bottom[0]) ** 2 + (z - bottom[1]) ** 2)

    femoral = graded_sphere(12 * MM)
    engine = ContactEngine(contact_model("foundation", 2.0), femoral, material("polyethylene"))
    found = engine.dwell(dished_insert(height), np.eye(3))
    assert found == pytest.approx(bottom, abs=0.2 * MM)
    assert zero_at(found)[[0, 2]] == pytest.approx(found)
    assert not zero_at(found)[[1, 3, 4, 5]].any()


def dish_case(applied):
    """A ball in a dish under forces, row by row."""
    engine = ContactEngine(contact_model("foundation", 2.0), ball(), material("polyethylene"))
    drive = machine(applied, (AP, SI, ML))
    motion = CycleMotion(knee_pose(drive.coordinates), -applied[:, SI], 1.0, 1, drive=drive)
    articular = ArticularSurface.of_insert(dish(50 * MM, spacing=2 * MM), 2 * MM)
    return WearCase(engine, articular, motion, Archard(1e-6), DENSITY)


FORCES = np.array(
    [
        [0, -600, 0, 0, 0, 0],
        [80, -900, 30, 0, 0, 0],
        [-50, -500, 0, 0, 0, 0],
        [0, -600, 0, 0, 0, 0],
    ],
    float,
)


@pytest.fixture(scope="module")
def driven():
    case = dish_case(FORCES)
    return case, *simulate_wear(case, 10, 1)


def test_positions_that_force_control_found_give_the_same_wear_in_displacement_control(driven):
    case, state, _ = driven
    maps = case.engine.maps(case.articular.surface, case.motion)
    prescribed = replace(case.motion, poses=maps.poses, drive=None)
    again = case.engine.maps(case.articular.surface, prescribed)
    assert again.pressure == pytest.approx(maps.pressure, abs=1e-6 * maps.pressure.max())
    same, _ = simulate_wear(replace(case, motion=prescribed), 10, 1)
    assert state.volume > 0
    assert same.volume == pytest.approx(state.volume, rel=1e-6)
    assert same.wear == pytest.approx(state.wear, abs=1e-6 * state.wear.max())


def test_rows_say_how_far_the_knee_went(driven):
    _, state, last = driven
    found = knee_coordinates(last.poses)
    row = state.rows[-1]
    assert (row["ap_low_mm"], row["ap_high_mm"]) == pytest.approx(
        (found[:, AP].min() / MM, found[:, AP].max() / MM)
    )
    assert row["ml_high_mm"] > 0.5 > 0.1 > row["ml_low_mm"]
    assert row["failed_rows"] == 0
    # the first and the last row ask the same, and are found from different places
    assert found[0] == pytest.approx(found[-1], abs=1e-5)


def test_a_row_without_equilibrium_is_left_out_of_the_cycle_and_too_many_end_it(driven):
    """The cycle without the row is that of a profile that never had it."""
    applied = np.insert(FORCES, 2, [3000, -500, 0, 0, 0, 0], axis=0)
    state, last = simulate_wear(dish_case(applied), 10, 1)
    assert list(last.failed) == [2] and state.rows[-1]["failed_rows"] == 1
    assert state.volume == pytest.approx(driven[1].volume, rel=1e-3)
    applied[3, AP] = 3000
    with pytest.raises(InputError, match="no contact in 2 of 3 frames"):
        simulate_wear(dish_case(applied[1:4]), 10, 1)


@pytest.mark.parametrize(
    ("turned", "words"),
    [
        (("axial_torque_Nm", "ap_mm"), "both 'ap_force_N' and 'ap_mm'"),
        (("axial_torque_Nm", "axial_torque_Nmm"), "unknown column 'axial_torque_Nmm'"),
        (("75,400", "75,0"), "'axial_force_N' is 0 in data row 4"),
        (("15,-60", "15,-6000"), "'ap_force_N' is -6000"),
    ],
)
def test_a_profile_of_forces_that_is_none_is_refused(tmp_path, turned, words):
    path = tmp_path / "cycle.csv"
    path.write_text(CYCLE.replace(*turned), encoding="utf-8")
    with pytest.raises(InputError, match=words):
        read_profile(path, 5)


@pytest.mark.parametrize(
    ("turned", "words"),
    [
        (("stiffness_N_per_mm = 30.0\n", ""), "it needs: stiffness_N_per_mm, gap_mm"),
        (("30.0", "-30.0"), "cannot be -30"),
        (("30.0", "30000.0"), "at most 1000"),
        (("30.0", "0"), "leave the table out"),
        (("30.0", "nan"), "cannot be nan"),
        (("30.0", "'stiff'"), "cannot be stiff"),
        (("gap_mm = 0.5", "gap_mm = -0.5"), "cannot be -0.5"),
        (("[axial_rotation]", "[axial_rotatoin]"), "did you mean axial_rotation"),
        (('sources = ["made up for a test"]', ""), "sources"),
        (("[ap]", "[ap"), "is not TOML"),
    ],
)
def test_springs_that_are_none_are_refused(tmp_path, turned, words):
    path = tmp_path / "springs.toml"
    path.write_text(SPRINGS.replace(*turned), encoding="utf-8")
    with pytest.raises(InputError, match=words):
        read_springs(path)


def test_a_spring_acts_on_what_a_force_is_given_for(tmp_path):
    profile, springs = tmp_path / "cycle.csv", tmp_path / "springs.toml"
    profile.write_text(CYCLE.replace("ap_force_N", "ml_force_N"), encoding="utf-8")
    springs.write_text(SPRINGS, encoding="utf-8")
    with pytest.raises(InputError, match="a spring for 'ap', but the profile gives no force"):
        read_profile(profile, 5).drive((0.0, 0.0), read_springs(springs))
    assert read_springs(springs).springs == {
        "ap": Spring(30e3, 0.5 * MM),
        "axial_rotation": Spring(pytest.approx(np.degrees(0.4)), pytest.approx(np.radians(1.0))),
    }


@pytest.fixture(scope="module")
def command(tmp_path_factory):
    folder = tmp_path_factory.mktemp("machine")
    for name, text in (("cycle.csv", CYCLE), ("springs.toml", SPRINGS)):
        (folder / name).write_text(text, encoding="utf-8")
    worn = ["wear", str(balls_scene(folder)), "--simulator", str(folder / "cycle.csv")]
    quick = ("--resolution", "4", "--frames-per-cycle", "5", "--updates", "1", "--cycles", "60000")
    return [*worn, *quick, "--springs", str(folder / "springs.toml")]


def test_the_report_says_which_control_and_where_it_found_the_knee(command):
    machine = {"simulator": command[3], "springs": command[-1], "resolution_mm": 4.0, "frames": 5}
    run = wear_run.prepare_wear(command[1], cycles=100, updates=1, **machine)
    report = run.compute()
    found = json.loads(json.dumps(report.as_dict()))
    assert any(line.startswith("force control: ap ") for line in report.lines())
    assert found["control"] == "force"
    assert found["found_in_equilibrium"] == ["ap", "axial_rotation"]
    assert found["springs"]["ap"] == {"stiffness_N_per_mm": 30.0, "gap_mm": 0.5}
    assert [row["status"] for row in found["last_cycle"]] == ["ok"] * 5
    assert [row["flexion_deg"] for row in found["last_cycle"]] == pytest.approx([0, 15, 8, 50, 0])
    places = [row["ap_mm"] for row in found["last_cycle"]]
    assert (found["ap_low_mm"], found["ap_high_mm"]) == (min(places), max(places))
    assert places[1] < places[0] < places[2]  # the femur goes where it is pushed
    assert found["failed_rows"] == 0 and "friction of 0.05 is left out" in found["notes"][1]


def test_springs_without_a_simulator_are_one_line(command, tmp_path, capsys):
    bare = [*command[:2], "--springs", command[-1], "--out", str(tmp_path / "out")]
    assert main(bare) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and "--simulator" in said[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_end_and_knows_its_springs(
    command, monkeypatch, capsys, tmp_path
):
    assert main([*command, "--out", str(tmp_path / "whole")]) == 0
    keep = wear_run.keep_state

    def keep_and_stop(*given):
        keep(*given)
        raise KeyboardInterrupt

    monkeypatch.setattr(wear_run, "keep_state", keep_and_stop)
    part = ["--out", str(tmp_path / "part")]
    assert main([*command, *part]) == 130
    monkeypatch.undo()
    softer = tmp_path / "springs.toml"
    softer.write_text(SPRINGS.replace("30.0", "20.0"), encoding="utf-8")
    capsys.readouterr()
    assert main([*command[:-1], str(softer), *part, "--resume"]) == 2
    assert "another simulation" in capsys.readouterr().err
    assert main([*command, *part, "--resume"]) == 0
    whole, again = ((tmp_path / name / "wear.csv").read_text() for name in ("whole", "part"))
    assert again == whole
