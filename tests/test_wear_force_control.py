"""Force control of the virtual simulator: equilibria with closed forms, and cycles of wear."""

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
from tkamb.studies.wear.engine import ArticularSurface, ContactEngine
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
from wear_bodies import DENSITY, MM, balls, balls_scene

AP, SI, ML, AXIAL_ROTATION = 0, 1, 2, 3
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
    """Return the drive of forces (f, 6), with the initial guess zero."""
    applied = np.atleast_2d(np.asarray(applied, float))
    all_springs = springs and Springs(springs, ("test",), {})
    return ForceDrive(np.zeros_like(applied), applied, free, np.zeros(6), all_springs)


def equilibrium(insert, femoral, drive, load, resolution=2.0):
    """Return the equilibrium coordinates (6,) of the first row, and the reason of failure."""
    model = contact_model("foundation", resolution=resolution * 1e-3)
    pair = ContactPair(femoral, insert, material("polyethylene-linear"))
    pose, reason = EquilibriumPoses(model, model.prepare(pair), drive).at(0, load, None)
    return knee_coordinates(pose), reason


def ball():
    return shapes.sphere(25 * MM, 3)


def dish(radius, depth=10 * MM, spacing=0.5 * MM):
    def height(x, z):
        return depth + radius - np.sqrt(radius**2 - x**2 - z**2)

    return dished_insert(height, 16 * MM, 16 * MM, spacing)


@pytest.mark.parametrize("share", [0.15, pytest.param(-0.05, marks=pytest.mark.slow)])
def test_the_normal_of_a_ball_in_a_dish_is_parallel_to_the_resultant(share):
    """tan(angle) = P/F, if both bodies are symmetric about the line of centres.

    The thickness h of the bed is not. Along an arc u of the dish, at the angle t, it grows by
    u sin(t). The pressure (1 - u²/a²)/h then has its centre at u = -a² sin(t)/(6 h). There the
    normal of the ball of radius r is turned by u/r. With 1/R = 1/r - 1/radius,
    F = pi M a⁴/(4 R h).
    """
    load, ball_radius, radius = 800.0, 25 * MM, 40 * MM
    applied = [share * load, -load, 0, 0, 0, 0]
    drive = machine(applied, (AP, SI))
    coordinates, reason = equilibrium(dish(radius), graded_sphere(ball_radius), drive, load, 0.5)
    assert not reason
    angle = np.arctan2(coordinates[AP], 10 * MM + radius - coordinates[SI])
    thickness = 10 * MM + radius * (1 - np.cos(angle))
    conformity = 1 / (1 / ball_radius - 1 / radius)
    stiffness = np.pi * material("polyethylene-linear").confined_modulus
    square = np.sqrt(4 * load * np.hypot(1, share) * conformity * thickness / stiffness)
    turn = square * np.sin(angle) / (6 * thickness * ball_radius)
    assert np.tan(angle - turn) == pytest.approx(share, rel=1e-3)


# mm: on a flat plate the map itself holds a ball (test_foundation has the closed form): with 0.3 %
# of the load at 2 mm, and with 3e-5 at this spacing, which is 0.5 µm of the spring.
FINE = 0.25


@pytest.mark.parametrize(("force", "gap"), [(60.0, 0.0), (-45.0, 0.7 * MM)])
def test_on_a_flat_plate_the_spring_balances_the_ap_force(force, gap):
    drive = machine([force, -500.0, 0, 0, 0, 0], (AP, SI), {"ap": Spring(30e3, gap)})
    coordinates, reason = equilibrium(flat_insert(10 * MM), ball(), drive, 500.0, FINE)
    assert not reason
    assert coordinates[AP] == pytest.approx(np.sign(force) * (abs(force) / 30e3 + gap), abs=2e-6)


@pytest.mark.parametrize(("torque", "gap"), [(-2.0, np.radians(2.5))])
def test_on_a_flat_plate_the_spring_balances_the_axial_torque(torque, gap):
    stiffness = np.degrees(0.4)  # 0.4 N·m/deg
    applied = [0, -900.0, 0, torque, 0, 0]
    drive = machine(applied, (SI, AXIAL_ROTATION), {"axial_rotation": Spring(stiffness, gap)})
    plate = flat_insert(10 * MM, 15 * MM, 34 * MM)
    coordinates, reason = equilibrium(plate, balls(), drive, 900.0, FINE)
    assert not reason
    rotation = np.sign(torque) * (abs(torque) / stiffness + gap)
    assert coordinates[AXIAL_ROTATION] == pytest.approx(rotation, abs=1e-4)


def test_a_force_without_resistance_has_no_equilibrium():
    drive = machine([60.0, -500.0, 0, 0, 0, 0], (AP, SI))
    _, reason = equilibrium(flat_insert(10 * MM), ball(), drive, 500.0)
    assert "no equilibrium" in reason or "initial guess" in reason


def test_the_dwell_position_is_the_lowest_position():
    """The lowest point of the dish is anterior and medial of the origin."""
    bottom = (6 * MM, -3 * MM)

    def height(x, z):
        return 10 * MM + 8.0 * ((x - bottom[0]) ** 2 + (z - bottom[1]) ** 2)

    femoral = graded_sphere(12 * MM)
    engine = ContactEngine(
        contact_model("foundation", resolution=2e-3), femoral, material("polyethylene")
    )
    dwell = engine.dwell(dished_insert(height), np.eye(3))
    assert dwell == pytest.approx(bottom, abs=0.2 * MM)
    assert zero_at(dwell)[[0, 2]] == pytest.approx(dwell)
    assert not zero_at(dwell)[[1, 3, 4, 5]].any()


def dish_case(applied):
    engine = ContactEngine(
        contact_model("foundation", resolution=2e-3), ball(), material("polyethylene")
    )
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


def test_equilibrium_poses_give_the_same_wear_in_displacement_control(driven):
    case, state, _ = driven
    maps = case.engine.maps(case.articular.surface, case.motion)
    prescribed = replace(case.motion, poses=maps.poses, drive=None)
    prescribed_maps = case.engine.maps(case.articular.surface, prescribed)
    assert prescribed_maps.pressure == pytest.approx(maps.pressure, abs=1e-6 * maps.pressure.max())
    prescribed_state, _ = simulate_wear(replace(case, motion=prescribed), 10, 1)
    assert state.volume > 0
    assert prescribed_state.volume == pytest.approx(state.volume, rel=1e-6)
    assert prescribed_state.wear == pytest.approx(state.wear, abs=1e-6 * state.wear.max())


def test_rows_of_the_table_have_the_range_of_released_coordinates(driven):
    _, state, last = driven
    coordinates = knee_coordinates(last.poses)
    row = state.rows[-1]
    assert (row["ap_low_mm"], row["ap_high_mm"]) == pytest.approx(
        (coordinates[:, AP].min() / MM, coordinates[:, AP].max() / MM)
    )
    assert row["ml_high_mm"] > 0.5 > 0.1 > row["ml_low_mm"]
    assert row["failed_rows"] == 0
    # the first and the last row have equal loads and different initial guesses
    assert coordinates[0] == pytest.approx(coordinates[-1], abs=1e-5)


def test_the_cycle_omits_failed_rows_and_fails_with_too_many(driven):
    applied = np.insert(FORCES, 2, [3000, -500, 0, 0, 0, 0], axis=0)
    state, last = simulate_wear(dish_case(applied), 10, 1)
    assert list(last.failed) == [2] and state.rows[-1]["failed_rows"] == 1
    assert state.volume == pytest.approx(driven[1].volume, rel=1e-3)
    applied[3, AP] = 3000
    with pytest.raises(InputError, match="no contact in 2 of 3 frames"):
        simulate_wear(dish_case(applied[1:4]), 10, 1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("axial_torque_Nm", "ap_mm"), "both 'ap_force_N' and 'ap_mm'"),
        (("axial_torque_Nm", "axial_torque_Nmm"), "unknown column 'axial_torque_Nmm'"),
        (("75,400", "75,0"), "'axial_force_N' is 0 in data row 4"),
        (("15,-60", "15,-6000"), "'ap_force_N' is -6000"),
    ],
)
def test_an_invalid_profile_of_forces_is_refused(tmp_path, change, words):
    path = tmp_path / "cycle.csv"
    path.write_text(CYCLE.replace(*change), encoding="utf-8")
    with pytest.raises(InputError, match=words):
        read_profile(path, 5)


@pytest.mark.parametrize(
    ("change", "words"),
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
def test_invalid_springs_are_refused(tmp_path, change, words):
    path = tmp_path / "springs.toml"
    path.write_text(SPRINGS.replace(*change), encoding="utf-8")
    with pytest.raises(InputError, match=words):
        read_springs(path)


def test_a_spring_needs_a_force_on_its_coordinate(tmp_path):
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
    arguments = ["wear", str(balls_scene(folder)), "--simulator", str(folder / "cycle.csv")]
    options = (
        "--resolution",
        "4",
        "--frames-per-cycle",
        "5",
        "--updates",
        "1",
        "--cycles",
        "60000",
    )
    return [*arguments, *options, "--springs", str(folder / "springs.toml")]


def test_the_report_has_control_springs_and_released_coordinates(command):
    options = {"simulator": command[3], "springs": command[-1], "resolution_mm": 4.0, "frames": 5}
    run = wear_run.prepare_wear(command[1], cycles=100, updates=1, **options)
    report = run.compute()
    content = json.loads(json.dumps(report.as_dict()))
    assert any(line.startswith("force control: ap ") for line in report.lines())
    assert content["control"] == "force"
    assert content["found_in_equilibrium"] == ["ap", "axial_rotation"]
    assert content["springs"]["ap"] == {"stiffness_N_per_mm": 30.0, "gap_mm": 0.5}
    assert [row["status"] for row in content["last_cycle"]] == ["ok"] * 5
    assert [row["flexion_deg"] for row in content["last_cycle"]] == pytest.approx([0, 15, 8, 50, 0])
    positions = [row["ap_mm"] for row in content["last_cycle"]]
    assert (content["ap_low_mm"], content["ap_high_mm"]) == (min(positions), max(positions))
    assert positions[1] < positions[0] < positions[2]  # the femur moves along the AP force
    assert content["failed_rows"] == 0 and "neglects the friction of 0.05" in content["notes"][1]


def test_springs_without_a_simulator_are_an_error_of_one_line(command, tmp_path, capsys):
    arguments = [*command[:2], "--springs", command[-1], "--out", str(tmp_path / "out")]
    assert main(arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and "--simulator" in lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_an_interrupted_run_is_resumed_only_with_its_springs(
    command, monkeypatch, capsys, tmp_path
):
    assert main([*command, "--out", str(tmp_path / "whole")]) == 0
    keep = wear_run.keep_state

    def keep_and_stop(*arguments):
        keep(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(wear_run, "keep_state", keep_and_stop)
    part = ["--out", str(tmp_path / "part")]
    assert main([*command, *part]) == 130
    monkeypatch.undo()
    other_springs = tmp_path / "springs.toml"
    other_springs.write_text(SPRINGS.replace("30.0", "20.0"), encoding="utf-8")
    capsys.readouterr()
    assert main([*command[:-1], str(other_springs), *part, "--resume"]) == 2
    assert "another simulation" in capsys.readouterr().err
    assert main([*command, *part, "--resume"]) == 0
    complete, resumed = ((tmp_path / name / "wear.csv").read_text() for name in ("whole", "part"))
    assert resumed == complete
