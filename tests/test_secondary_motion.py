"""Equilibrium of the five released knee coordinates under contact and ligaments."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tkamb.contact.model import condyle_wrenches
from tkamb.geometry.frames import knee_pose
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee.balance import BalanceStatus
from tkamb.knee.equations import unsolved
from tkamb.knee.load import total_wrench
from tkamb.knee.released_forces import SCALE, external_wrench
from tkamb.run.read_scene import recording_of
from tkamb.run.simulation import FrameSolver

ROOT = Path(__file__).parents[1]
BEND = ROOT / "models" / "deep_knee_bend" / "scene.toml"
COARSE = {"contact.model": "foundation", "contact.resolution_mm": 2.0}
DM = ROOT / "models" / "dm" / "scene.toml"
DATA = ROOT.parent / "shared" / "data" / "dm"
ALL = ["ap", "ml", "axial_rotation", "adduction"]


def case_of(scene, more=None, **contact):
    overrides = COARSE | (more or {})
    overrides |= {"contact.released": ALL}
    overrides |= {f"contact.{key}": value for key, value in contact.items()}
    return load_case(load_scene(scene, overrides))


def side_of(scene, more=None, **contact):
    case = case_of(scene, more, **contact)
    return recording_of(case)


@pytest.fixture(scope="module")
def bend():
    return side_of(BEND)


@pytest.fixture(scope="module")
def equilibria(bend):
    """Return a few frames, each with the previous frame as initial guess."""
    results = {}
    for k in (40, 41, 42, 60, 80):
        results[k] = bend.frame(k, [frame.next for frame in results.values()])
    return results


def test_the_shank_is_in_equilibrium(bend, equilibria):
    """The sum of ground, weight and inertia, ligaments, patellar ligament and contact is zero."""
    for k, frame in equilibria.items():
        geometry = frame.equilibrium.geometry
        total = external_wrench(geometry, frame.equilibrium.coordinates)
        shank = [load for load in geometry.ligaments if load.link.startswith("tibia")]
        pull = [p for p in geometry.extensor.patellar_ligament if p.link == "tibia"]
        total = total + total_wrench(shank, np.zeros(3))
        total = total + frame.loads.values["patellar_ligament"] * total_wrench(pull, np.zeros(3))
        for name, condyle in frame.geometry.condyles.items():
            push = -frame.loads.values[f"{name}_normal"] * condyle.direction(bend.knee.friction)
            total = total + np.concatenate([push, np.cross(condyle.point, push)])
        assert np.abs(total[:3]).max() < 0.2, k
        assert np.abs(total[3:]).max() < 0.02, k


def test_the_loads_of_the_equations_are_those_of_the_deformation(equilibria):
    for frame in equilibria.values():
        for name in ("ap", "ml"):
            assert abs(frame.loads.values[f"residual_{name}"]) < 0.1
        assert abs(frame.loads.values["residual_axial"]) < 0.03
        for side, condyle in condyle_wrenches(frame.contact, 0.0).items():
            assert frame.loads.values[f"{side}_normal"] == pytest.approx(condyle.force, abs=0.1)
        assert np.allclose(frame.contact.pose, knee_pose(frame.equilibrium.coordinates))


def test_flexion_and_coordinates_that_are_not_released_stay_recorded(bend):
    partly = side_of(BEND, released=["ml", "adduction"])
    frame = partly.frame(60)
    displacement = np.abs(frame.equilibrium.coordinates - partly.motion.coordinates[60])
    assert frame.contact is not None
    assert (displacement[[0, 3, 5]] == 0).all()
    assert (displacement[[2, 4]] > 0).all()


@pytest.mark.parametrize(
    "away",
    [
        [5e-3, 2e-3, 0, 0, np.radians(2)],
        [-5e-3, 1e-3, 0, np.radians(-5), np.radians(2)],
        [0, 3e-3, -5e-3, np.radians(5), np.radians(-5)],
        # over the rim of the insert; 1 mm and 1 deg more are out of the foundation's range
        [-4e-3, 0, 4e-3, np.radians(-4), 0],
    ],
)
def test_guesses_millimetres_and_degrees_away_reach_the_same_equilibrium(bend, equilibria, away):
    expected = equilibria[60].equilibrium.coordinates
    start = bend.method.starts.at_first_touch(expected + np.append(away, 0.0))
    result = bend.method.search.find(bend.instant(60), start)
    assert result.problem == ""
    assert np.abs((result.coordinates - expected) * SCALE).max() < 2e-5


def test_a_frame_that_needs_flexors_has_a_slack_quadriceps(bend):
    """The ground reaction is 0.2 m in front of the knee: a patellar ligament that could push would
    drive the femur off the insert.
    """
    case = case_of(BEND)
    ground = replace(case.ground, point=case.ground.point + np.array([0.2, 0, 0]))
    case = replace(case, ground=ground)
    recording = recording_of(case)
    for k in (5, 40):
        frame = recording.frame(k)
        knee = frame.equilibrium
        assert knee.problem == "" and frame.loads.values["muscle_quadriceps"] == 0.0
        assert knee.balance.status is BalanceStatus.OK and knee.patella.status.found
        assert frame.loads.values["residual_flexion"] < -10.0
        away = np.array([2e-3, 0, 1e-3, 0, np.radians(1), 0])
        start = recording.method.starts.at_first_touch(knee.coordinates + away)
        result = recording.method.search.find(recording.instant(k), start)
        assert np.abs((result.coordinates - knee.coordinates) * SCALE).max() < 2e-5


def test_a_guess_beyond_the_rim_is_reported_as_failed(bend, equilibria):
    equilibrium = equilibria[60].equilibrium.coordinates
    for size in (5.0, 8.0):
        away = size * np.array([-1e-3, 0, 1e-3, np.radians(-1), 0, 0])
        start = bend.method.starts.at_first_touch(equilibrium + away)
        result = bend.method.search.find(bend.instant(60), start)
        assert result.problem == "released: out of the contact model's range"


def test_friction_changes_the_equilibrium(bend, equilibria):
    """Without friction the equilibrium differs by up to 5 mm."""
    smooth = side_of(BEND, friction=0.0)
    frame = smooth.frame(60)
    away = np.abs((frame.equilibrium.coordinates - equilibria[60].equilibrium.coordinates) * SCALE)
    assert 1e-5 < away.max() < 5e-3
    assert frame.equilibrium.balance.status is BalanceStatus.OK


def test_a_frame_without_equilibrium_fails_with_the_reason(bend):
    """Without ligaments and far from the insert there is no equilibrium."""
    case = load_case(load_scene(BEND, COARSE | {"contact.released": ALL, "ligament": []}))
    recording = recording_of(case)
    start = case.motion.coordinates[60].copy()
    start[0] += 60e-3
    result = recording.method.search.find(recording.instant(60), start)
    assert result.problem.startswith("released")


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason="needs subject DM's files beside the project")
def test_a_condyle_recorded_on_the_eminence_slides_back_into_the_dish():
    """At half of DM's cycle one condyle carries all of the load, unless ML and adduction are
    released.
    """
    few = {"motion.frames": 21}
    frame = side_of(DM, few, released=[]).frame(10)
    lean = [np.degrees(np.arccos(c.normal[1])) for c in frame.geometry.condyles.values()]
    assert max(lean) > 25
    assert frame.contact.lateral is None
    peak = frame.contact.pressure.max()
    freed = side_of(DM, few, released=["ml", "adduction"])
    frame = freed.frame(10)
    lean = [np.degrees(np.arccos(c.normal[1])) for c in frame.geometry.condyles.values()]
    assert max(lean) < 12
    assert frame.contact.medial.force > 250
    assert frame.contact.lateral.force > 250
    assert frame.contact.pressure.max() < 0.7 * peak
    moved = frame.equilibrium.coordinates - freed.motion.coordinates[10]
    assert abs(moved[2]) < 2e-3


def test_a_femur_beside_the_insert_fails_with_the_reason(bend):
    """A recorded pose far off the insert has no initial guess."""
    case = case_of(BEND)
    away = case.motion.coordinates + np.array([0.2, 0, 0, 0, 0, 0])
    case = replace(case, motion=replace(case.motion, coordinates=away))
    recording = recording_of(case, near=True)
    frame = recording.frame(60)
    assert frame.contact is None
    assert "over the insert" in frame.problem
    assert frame.loads.problems == (frame.problem,)


def test_a_frame_in_equilibrium_whose_equations_fail_has_no_numbers(monkeypatch):
    """Only inputs, computing times and the statistics of the search have finite numbers."""
    overrides = COARSE | {"contact.released": ALL}
    solver = FrameSolver(load_case(load_scene(BEND, overrides)))
    monkeypatch.setattr(
        "tkamb.knee.instant.solve_knee", lambda *_: unsolved(["no signs are right"])
    )
    _, row, arrays = solver.solve(60)
    assert row["status"].startswith("failed: no signs are right")
    finite = {name for name, value in row.items() if name != "status" and np.isfinite(value)}
    assert finite == {
        *("time_s", "flexion_deg", "body_seconds", "query_seconds", "contact_seconds"),
        *("contact_trials", "coupling_iterations", "smallest_stiffness_N_per_mm"),
    }
    assert arrays is None
