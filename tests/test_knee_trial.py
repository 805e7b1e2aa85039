"""Muscle lines across the knee have the wrench of the model's paths. Their sharing is optimal."""

import numpy as np
import pytest
from scipy.optimize import minimize

from jw_gait import JW, gait, needs_jw
from opensim_models import PUBLISHED, model
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import MIRROR, inverse, transform
from tkamb.io.importing.anatomy import find_leg
from tkamb.io.importing.links import find_links
from tkamb.io.opensim.motion import CoordinateMotion
from tkamb.io.recordings.meshes import axes_rotation, load_surface
from tkamb.io.recordings.recording_tables import GroundReactionTable
from tkamb.run.muscles import Sharing
from tkamb.run.muscles.knee_trial import LegRecording, knee_trial, load_knee_trial
from tkamb.run.muscles.trial import trial_problems
from tkamb.show.storage import write_storage

EXTENSORS = {"recfem", "vasint", "vaslat", "vasmed"}
CROSSING = {"bflh", "bfsh", "gaslat", "gasmed", "grac", "sart", "semimem", "semiten", "tfl"}


@pytest.fixture(scope="module")
def jw():
    """Return links, every 40th frame of og3 as a trial, and the muscles' forces on the bones."""
    trial = gait(1.9, 4.2)
    stride = slice(None, None, 40)
    motion = trial.motion
    motion = CoordinateMotion(
        motion.time[stride], motion.q[stride], motion.rates[stride], motion.accelerations[stride]
    )
    loads = {body: wrench[stride] for body, wrench in trial.loads.items()}
    leg = find_leg(trial.kinematics.model, "right")
    mesh = JW / "geometry" / "tibial_insert.stl"
    insert = load_surface(mesh, "m", "-x,+y,-z", name="insert", closed=True)
    placement = insert_placement(insert, axes_rotation("-x,+y,-z"))
    links = find_links(leg, placement, "-x,+y,-z", {}, False)
    bones = trial_problems(leg, motion, loads, Sharing())[1]
    return links, knee_trial(links, motion, loads, Sharing()), bones


@needs_jw
def test_the_muscles_that_cross_the_knee_are_found(jw):
    _, trial, _ = jw
    names = np.array(trial.muscles)
    assert set(names[trial.extensor]) == EXTENSORS
    assert set(names[trial.crossing]) == CROSSING
    assert trial.problems.coordinates[trial.flexion] == "knee_flexion"


@needs_jw
def test_lines_across_the_knee_have_the_wrench_of_the_paths(jw):
    """The wrenches on shank and foot include the force of a shrinking wrap object on a point."""
    links, trial, bones = jw
    link = links.tibia
    pulls = bones.pull_on(("tibia", "foot"), "tibia")[:, trial.crossing]
    tibia, femur = (bones.poses[:, bones.index(name)] for name in ("tibia", "femur"))
    thigh = transform(inverse(tibia) @ femur @ links.femur, trial.thigh)
    shank = transform(link, trial.shank)
    along = (thigh - shank) / np.linalg.norm(thigh - shank, axis=-1, keepdims=True)
    moment = np.cross(shank, along)
    differences = np.abs(np.concatenate([moment, along], axis=-1) - pulls).max(axis=(0, 2))
    names = np.array(trial.muscles)[trial.crossing]
    assert {n for n, d in zip(names, differences, strict=True) if d > 1e-9} == set()


@needs_jw
def test_slsqp_finds_the_same_forces_in_gait(jw):
    """Another solver of the quadratic programme of a leg, hip to subtalar joint, agrees."""
    problems = jw[1].problems
    for k in range(0, len(problems.moment), 3):
        problem = problems.frame(k)
        activation, reserve, _, status = problems.solved(k)
        assert status == "ok"
        optimum = minimize(
            problem.cost,
            np.full(len(activation), 0.1),
            jac=problem.gradient,
            bounds=list(zip(problem.lowest, problem.highest, strict=True)),
            method="SLSQP",
            options={"ftol": 1e-13, "maxiter": 300},
        )
        assert problem.cost(activation) <= problem.cost(optimum.x) * (1 + 1e-9)
        np.testing.assert_allclose(activation, optimum.x, atol=2e-4)
        np.testing.assert_allclose(problem.others(optimum.x), reserve, atol=0.02)


def walked(names, time, left):
    """Return coordinate -> (n,) of a made-up stride, or of its image in the sagittal plane."""
    reflected = {"pelvis_list", "pelvis_rotation", "pelvis_tz"}
    swing = {"hip_flexion": 0.3, "hip_adduction": 0.1, "hip_rotation": 0.1, "ankle_angle": 0.15}
    result = {name: np.zeros_like(time) for name in names}
    for leg_side, phase in (("r", 0.0), ("l", 1.3)):
        at = {"r": "l", "l": "r"}[leg_side] if left else leg_side
        for k, (name, size) in enumerate(swing.items()):
            result[f"{name}_{at}"] = size * np.sin(6 * time + phase + k)
        result[f"knee_angle_{at}"] = 0.5 + 0.25 * np.sin(6 * time + phase)
    for k, name in enumerate(("pelvis_tilt", *sorted(reflected))):
        sign = -1.0 if left and name in reflected else 1.0
        result[name] = sign * (0.02 + 0.05 * np.sin((4 + k) * time))
    return result | {"pelvis_tx": 1.2 * time, "pelvis_ty": 0.95 + 0.02 * np.sin(9 * time)}


def pushed_up(path, time, left):
    """Return the table of a made-up ground reaction, or of its image in the sagittal plane."""
    z = -1.0 if left else 1.0
    values = {
        "force_1": 80.0 * np.sin(3 * time),
        "force_2": np.full_like(time, 700.0),
        "force_3": z * 30.0 * np.cos(4 * time),
        "point_1": 1.2 * time,
        "point_2": np.zeros_like(time),
        "point_3": z * (0.1 + 0.02 * time),
    }
    write_storage(path, {"time": time} | values, in_degrees=False)
    columns = {name: name for name in ("time", *values)}
    return GroundReactionTable(file=path, columns=columns, length_unit="m", cutoff_Hz=6.0)


def test_the_left_leg_of_a_symmetric_model_is_the_mirror_image_of_the_right(tmp_path):
    """A mirrored motion gives the same moments, arms and strengths, and mirrored lines."""
    time, result = np.linspace(0.0, 1.0, 41), {}
    names = list(model("Rajagopal2016").coordinates)
    for side in ("right", "left"):
        path = tmp_path / f"{side}.mot"
        columns = {"time": time} | walked(names, time, side == "left")
        write_storage(path, columns, in_degrees=False)
        mesh = {"insert_placement": None, "mesh_axes": "+x,+y,+z"}
        options = {"markers": None, "laboratory_axes": "+x,+y,+z", "cutoff": 6.0}
        options["ground"] = pushed_up(tmp_path / f"{side}_ground.mot", time, side == "left")
        recording = LegRecording(
            PUBLISHED["Rajagopal2016"], side, path, **options, **mesh, sharing=Sharing()
        )
        result[side] = load_knee_trial(recording, time[5:36:5])
    (links, right), (mirrored_links, left) = result["right"], result["left"]
    assert [name[:-2] for name in right.muscles] == [name[:-2] for name in left.muscles]
    assert all(name.endswith("_l") for name in left.muscles) and len(left.muscles) == 40
    for name in ("moment", "arms", "active", "passive"):
        expected, mirrored = getattr(right.problems, name), getattr(left.problems, name)
        np.testing.assert_allclose(
            mirrored, expected, atol=1e-9 * np.abs(expected).max(initial=1.0)
        )
    np.testing.assert_allclose(left.shank @ MIRROR, right.shank, atol=1e-12)
    np.testing.assert_allclose(left.thigh @ MIRROR, right.thigh, atol=1e-12)
    np.testing.assert_allclose(mirrored_links.hip @ MIRROR, links.hip, atol=1e-12)
    np.testing.assert_array_equal(left.extensor, right.extensor)
