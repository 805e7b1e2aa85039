"""The residual that a press reports, and the accuracy of its result from any initial guess."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from independent_residual import difference, recorded_solutions
from lattice_bodies import condyles, dished_insert, pair
from random_presses import ALLOWED, prepared, presses
from tkamb.contact.lattice import model as lattice_model
from tkamb.contact.lattice.settings import LatticeSolverSettings
from tkamb.contact.lattice.solver import solve
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus
from tkamb.geometry.frames import knee_pose
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.run.simulation import FrameSolver

MODELS = Path(__file__).parents[1] / "models"
DATA = Path(__file__).parents[2] / "shared" / "data"
POSE = knee_pose([1e-3, 0.0, 0.3e-3, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def coarse():
    return prepared(3.0)


@cache
def usual(name):
    """Return a model and its state for two spheres in a dish."""
    model = contact_model(name, resolution=3e-3)
    bodies = pair(condyles(subdivisions=4), dished_insert(cells=24), material("polyethylene"))
    return model, model.prepare(bodies)


@pytest.mark.parametrize("load", [1.0, 300.0, 2500.0, 16e3])
@pytest.mark.parametrize("name", ["lattice", "fe"])
def test_the_reported_residual_equals_an_independent_measurement(name, load, monkeypatch):
    """Without a guess and after a heavier load; equal to 1e-6 of the load."""
    (model, state), solutions = usual(name), []

    def storing_solve(*arguments):
        solutions.append(solve(*arguments))
        return solutions[-1]

    monkeypatch.setattr(lattice_model, "solve", storing_solve)
    _, before = model.press_from(state, 1.5 * load, POSE)
    for start in (None, before):
        result = model.press(state, load, POSE, start)
        solution, settings = solutions[-1], LatticeSolverSettings()
        vertical_force = solution.forces.force @ solution.planes.normals[:, 1]
        assert result.status is ContactStatus.OK and solution.residual.within(settings)
        assert abs(-vertical_force / load - 1) < 1e-9 and (solution.forces.force >= 0).all()
        assert difference(state, solution, result) < 1e-6


def check(cases):
    for case in cases:
        if "reference" in case:  # at the rim of the condyles even the precise press fails
            assert case["load_N"] > 20e3 and case["status"] != "ok", case
            continue
        assert case["status"] == "ok", case
        assert (np.array(case["errors"]) <= ALLOWED).all(), case


def test_results_agree_with_precise_solutions_from_any_guess(coarse):
    """Approach within 5e-4, peak within 1e-3 and area within 2e-3, from 1 N to 24 kN."""
    check(presses(*coarse, *prepared(3.0, 1e-6), np.random.default_rng(1), 12))


@pytest.mark.slow
@pytest.mark.parametrize("mm", [0.7, 1.0, 2.0, 3.0])
def test_many_presses_agree_with_precise_solutions(mm):
    """50 presses for each cell size, as in `scripts/measure/press_accuracy`."""
    check(presses(*prepared(mm), *prepared(mm, 1e-6), np.random.default_rng(int(10 * mm)), 50))


@pytest.mark.parametrize("heavy", [8e3, 20e3])
def test_a_light_press_does_not_depend_on_a_heavy_one_at_another_pose(coarse, heavy):
    """With the heavy press's forces as initial guess every node would be in contact."""
    model, state = coarse
    for x in (-1.5e-3, 2e-3):
        _, start = model.press_from(state, heavy, knee_pose([x, 0.0, 1e-3, 0.0, 0.02, 0.0]))
        for load in (1.0, 4.0, 30.0):
            result, alone = (model.press(state, load, POSE, one) for one in (start, None))
            assert result.status is ContactStatus.OK
            assert result.approach == pytest.approx(alone.approach, rel=1e-3)


FRAMES = {
    "deep_knee_bend/scene.toml": (0, 60, 100),
    "dm/scene.toml": (20, 62),
    "jw/ngait_og3_measured.toml": (10,),
}


@pytest.mark.parametrize(
    "scene", [*list(FRAMES)[:2], pytest.param(list(FRAMES)[2], marks=pytest.mark.slow)]
)
def test_the_reported_residual_of_frames_equals_an_independent_measurement(scene):
    """Equal to 1e-6 of the load. For all frames: `scripts/measure/residuals`."""
    if not scene.startswith("deep") and not DATA.is_dir():
        pytest.skip("the measured data are missing")
    changes = {"contact.model": "lattice", "contact.resolution_mm": 3.0}
    solver = FrameSolver(load_case(load_scene(MODELS / scene, changes)))
    with recorded_solutions() as presses:
        for k in FRAMES[scene]:
            solver.solve(k)
    assert len(presses) >= len(FRAMES[scene])
    for state, solution, result in presses:
        assert difference(state, solution, result) < 1e-6
        assert result.residual <= LatticeSolverSettings().force_tolerance


def test_a_larger_tolerance_exceeds_the_allowed_error(coarse):
    """With a hundred times the tolerance, the error of the approach is above its limit."""
    model, state = coarse
    best = model.press(state, 8e3, POSE)
    rough = replace(model, tolerance=0.1).press(state, 8e3, POSE)
    assert rough.residual > 2e-3
    assert abs(rough.approach / best.approach - 1) > 5e-4
