"""The lines across the knee of subject JW: the same wrench as the model's paths, and the rows."""

import numpy as np
import pytest
from scipy.optimize import minimize

from jw_gait import JW, gait, needs_jw
from tkamb.geometry.frames import inverse, transform
from tkamb.importing.anatomy import find_leg
from tkamb.importing.links import find_links
from tkamb.inputs.meshes import load_surface
from tkamb.muscles import Sharing
from tkamb.muscles.knee_trial import knee_trial
from tkamb.muscles.trial import trial_problems
from tkamb.opensim.motion import CoordinateMotion

EXTENSORS = {"recfem", "vasint", "vaslat", "vasmed"}
CROSSING = {"bflh", "bfsh", "gaslat", "gasmed", "grac", "sart", "semimem", "semiten", "tfl"}


@pytest.fixture(scope="module")
def jw():
    """Return links, every 40th frame of og3 as a trial, and what acts on the bones."""
    trial = gait(1.9, 4.2)
    some = slice(None, None, 40)
    motion = trial.motion
    motion = CoordinateMotion(
        motion.time[some], motion.q[some], motion.rates[some], motion.accelerations[some]
    )
    loads = {body: wrench[some] for body, wrench in trial.loads.items()}
    leg = find_leg(trial.kinematics.model, "right")
    mesh = JW / "geometry" / "tibial_insert.stl"
    insert = load_surface(mesh, "m", "-x,+y,-z", name="insert", closed=True)
    links = find_links(leg, insert, "-x,+y,-z", {}, False)
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
def test_their_lines_have_the_wrench_of_the_paths_on_shank_and_foot(jw):
    """In the model's own pose; a wrap object that yields to a point adds what it pushes with."""
    links, trial, bones = jw
    link = links.tibia
    pulls = bones.pull_on(("tibia", "foot"), "tibia")[:, trial.crossing]
    tibia, femur = (bones.poses[:, bones.index(name)] for name in ("tibia", "femur"))
    thigh = transform(inverse(tibia) @ femur @ links.femur, trial.thigh)
    shank = transform(link, trial.shank)
    along = (thigh - shank) / np.linalg.norm(thigh - shank, axis=-1, keepdims=True)
    moment = np.cross(shank, along)
    apart = np.abs(np.concatenate([moment, along], axis=-1) - pulls).max(axis=(0, 2))
    names = np.array(trial.muscles)[trial.crossing]
    assert {n for n, d in zip(names, apart, strict=True) if d > 1e-9} == set()


@needs_jw
def test_slsqp_finds_the_same_forces_in_gait(jw):
    """The quadratic programme of whole legs, hip to subtalar joint, by another solver."""
    problems = jw[1].problems
    for k in range(0, len(problems.moment), 3):
        problem = problems.frame(k)
        activation, reserve, _, status = problems.solved(k)
        assert status == "ok"
        other = minimize(
            problem.cost,
            np.full(len(activation), 0.1),
            jac=problem.gradient,
            bounds=list(zip(problem.lowest, problem.highest, strict=True)),
            method="SLSQP",
            options={"ftol": 1e-13, "maxiter": 300},
        )
        assert problem.cost(activation) <= problem.cost(other.x) * (1 + 1e-9)
        np.testing.assert_allclose(activation, other.x, atol=2e-4)
        np.testing.assert_allclose(problem.others(other.x), reserve, atol=0.02)
