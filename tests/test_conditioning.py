"""Nearly singular equations: condition number and status of the frame."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from scenes import MODEL, write_scene
from tkamb import simulate
from tkamb.geometry.frames import transform
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee.equations import solve_knee
from tkamb.knee.frame import Frame
from tkamb.knee.load import PointForces
from tkamb.knee.unknowns import UNKNOWNS
from tkamb.run.read_scene import recording_of
from tkamb.run.recording import Recording
from tkamb.run.status import FAILED, frame_status

MIDDLE = 60


@cache
def recording(friction: float = 0.05) -> Recording:
    """Return the equations of the shipped bend."""
    return recording_of(load_case(load_scene(MODEL / "scene.toml", {"contact.friction": friction})))


@cache
def shipped_frame() -> Frame:
    """Return the solved middle frame of the shipped bend."""
    return recording().loads(MIDDLE)


def contact_axis(frame: Frame) -> np.ndarray:
    """Return the midpoint of the condyles' contact points (3,)."""
    return np.mean([condyle.point for condyle in frame.geometry.condyles.values()], axis=0)


def solved_with_arm(arm: float):
    """Solve the shipped frame with the patellar ligament rotated about its proximal end.

    Args:
        arm: distance of the ligament from the contact, m, positive if it is in front.
    """
    geometry = shipped_frame().geometry
    on_patella, on_tibia = geometry.extensor.patellar_ligament
    to_contact = contact_axis(shipped_frame()) - on_patella.points[0]
    distance = np.hypot(*to_contact[:2])
    angle = np.arctan2(to_contact[1], to_contact[0]) + np.arcsin(arm / distance)
    direction = np.array([[np.cos(angle), np.sin(angle), 0.0]])
    ligament = (
        replace(on_patella, forces=direction),
        replace(on_tibia, points=on_patella.points, forces=-direction),
    )
    extensor = replace(geometry.extensor, patellar_ligament=ligament)
    return solve_knee(replace(geometry, extensor=extensor), 0.05)


def test_condition_number_grows_as_one_over_the_moment_arm():
    arms = np.array([0.045, 0.02, 0.01, 0.005, 0.002, 0.001])
    condition = np.array([solved_with_arm(arm).condition for arm in arms])
    assert ((condition * arms > 6.0) & (condition * arms < 10.0)).all()
    assert condition[0] < 220.0


@pytest.mark.parametrize("arm", [5e-4, 1e-5, 0.0, -1e-5])
def test_a_patellar_ligament_through_the_contact_makes_the_equations_singular(arm):
    loads = solved_with_arm(arm)
    assert loads.problems == ("singular equations",)
    assert loads.condition > UNKNOWNS.max_condition
    assert loads.values == {}
    assert np.isnan(loads.contact_force).all()


def test_a_singular_frame_fails_and_the_other_frames_do_not(tmp_path):
    """The ligament of this scene passes through the contact in one frame."""
    frame = shipped_frame()
    proximal = frame.geometry.extensor.patellar_ligament[0].points[0]
    distal = proximal + 1.3 * (contact_axis(frame) - proximal)
    chain = recording().knee.chain
    in_tibia = transform(chain.insert_in_tibia, distal) * 1e3
    path = write_scene(
        tmp_path,
        patellar_ligament__wrap=False,
        patellar_ligament__distal__point_mm=in_tibia.tolist(),
    )
    results = simulate(path, frames=slice(MIDDLE - 20, MIDDLE + 21, 20))
    assert results.status[1].startswith(FAILED + "singular equations")
    for name in ("force_total_N", "quadriceps_N", "patellofemoral_N", "medial_peak_pressure_MPa"):
        assert np.isnan(results[name][1])
    assert results["condition_number"][1] > UNKNOWNS.max_condition
    for k, status in enumerate(results.status):
        failed = status.startswith(FAILED)
        assert failed == np.isnan(results["force_total_N"][k])
        assert failed == np.isnan(results["approach_mm"][k])
        assert failed or results["condition_number"][k] < UNKNOWNS.max_condition


def test_a_quadriceps_through_the_patellofemoral_contact_makes_the_equations_singular():
    """Such a quadriceps cannot balance the patellar ligament."""
    geometry = shipped_frame().geometry
    quadriceps = geometry.muscles[0].loads
    (on_patella,) = (load for load in quadriceps if load.link == "patella")
    shift = geometry.extensor.contact_point - on_patella.points[0]
    moved = tuple(PointForces(one.link, one.points + shift, one.forces) for one in quadriceps)
    muscles = (replace(geometry.muscles[0], loads=moved),)
    loads = solve_knee(replace(geometry, muscles=muscles), 0.05)
    assert loads.problems == ("singular equations",)
    assert loads.values == {}


@pytest.mark.parametrize("friction", [0.0, 1.0])
def test_a_condyle_s_force_is_at_the_friction_angle_from_its_normal(friction):
    """Friction acts against the sliding."""
    frame = recording(friction).loads(MIDDLE)
    assert frame.loads.problems == ()
    assert frame.loads.condition < 500.0
    for side, condyle in frame.geometry.condyles.items():
        force = condyle.direction(friction) * frame.loads.values[f"{side}_normal"]
        normal = force @ condyle.normal
        tangential = force - normal * condyle.normal
        assert np.linalg.norm(tangential) == pytest.approx(friction * normal, rel=0.02, abs=1e-9)
        assert tangential @ condyle.sliding <= 1e-12 * normal  # rounding if there is no friction
    total = np.linalg.norm(frame.loads.contact_force)
    assert total == pytest.approx(np.linalg.norm(shipped_frame().loads.contact_force), rel=0.5)


def noisy_scene(folder):
    """Write the shipped bend with 0.5 mm and 0.5 deg of noise (standard deviation)."""
    cutoffs = {f"{table}__cutoff_Hz": 2.0 for table in ("motion", "tibia", "ground_reaction")}
    path = write_scene(folder, **cutoffs)
    file = path.parent / "motion.csv"
    header = file.read_text(encoding="utf-8").split("\n", 1)[0]
    rows = np.loadtxt(file, delimiter=",", skiprows=1)
    rows[:, 1:7] += np.random.default_rng(5).normal(scale=0.5, size=(len(rows), 6))
    np.savetxt(file, rows, "%.9g", ",", header=header, comments="")
    return path


def test_noise_of_fluoroscopy_is_flagged(tmp_path):
    path = noisy_scene(tmp_path)
    case = load_case(load_scene(path, {"contact.adjust": True}))
    noisy = recording_of(case)
    changes, flag_count = [], 0
    for k in range(5, 101, 15):
        frame = noisy.loads(k)
        status, force = frame_status(case, k, frame), frame.loads.contact_force
        assert status.startswith(FAILED) == bool(np.isnan(force).any())
        if status.startswith(FAILED):
            continue
        assert frame.loads.condition < UNKNOWNS.max_condition
        flag_count += "filter moves the recorded pose" in status
        clean = recording().loads(k).loads.contact_force
        changes.append((np.linalg.norm(force) - np.linalg.norm(clean)) / case.body_weight)
    assert len(changes) >= 6
    assert flag_count >= 4
    assert np.sqrt(np.mean(np.square(changes))) < 0.15
