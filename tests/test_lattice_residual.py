"""The residual that a press reports, and how near its answer is, whatever it starts from."""

from dataclasses import replace

import numpy as np
import pytest

from lattice_bodies import condyles, dished_insert, pair
from tkamb.contact.lattice import model as lattice_model
from tkamb.contact.lattice.settings import LatticeSolverSettings
from tkamb.contact.lattice.solver import solve
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus
from tkamb.geometry.frames import knee_pose

POSE = knee_pose([1e-3, 0.0, 0.3e-3, 0.0, 0.0, 0.0])


def prepared(mm, tolerance=1e-3):
    bodies = pair(condyles(subdivisions=4), dished_insert(cells=24), material("polyethylene"))
    model = contact_model("lattice", mm, tolerance=tolerance)
    return model, model.prepare(bodies)


@pytest.fixture(scope="module")
def coarse():
    return prepared(3.0)


def pose_of(rng):
    """Return a random pose within some millimetres and degrees."""
    x, z = rng.uniform([-2e-3, -1e-3], [2e-3, 1e-3])
    turned = np.radians(rng.uniform([-0.5, -3.0, -5.0], [0.5, 3.0, 5.0]))
    return knee_pose([x, 0.0, z, *turned])


def recomputed(state, solution, load):
    """Return the residuals of a solution from the law of the cells and the femoral mesh alone.

    The forces come from the assembled stiffness, the gaps from rays fired here: nothing of the
    solver, its factor or its condensed compliance is used.
    """
    problem, solid = state.problem, state.problem.solid
    nodes = problem.contact_nodes[solution.candidates]
    force = solution.forces.force[:, None] * solution.planes.normals
    outside = -solid.internal_force(solution.field)
    outside[nodes] += force
    outside = outside.ravel()[~problem.held]
    return np.linalg.norm(outside) / np.linalg.norm(force), abs(-force[:, 1].sum() / load - 1)


def gap_of(state, solution, pose):
    """Return the largest distance of a loaded node from the femoral surface, relative."""
    nodes = state.problem.contact_nodes[solution.candidates]
    moved = solution.field[nodes]
    where = state.problem.surface_points[solution.candidates] + moved
    points, normals = state.problem.femoral.over(where, pose)
    gap = np.einsum("ij,ij->i", normals, where - points)
    loaded = solution.forces.force > 0
    return np.abs(gap[loaded]).max() / np.abs(moved[loaded]).max()


@pytest.mark.parametrize("load", [1.0, 300.0, 2500.0, 16e3])
@pytest.mark.parametrize("name", ["lattice", "fe"])
def test_the_reported_residual_is_the_one_that_others_measure(name, load, monkeypatch):
    """From rest and from a heavier load before: equal to 1e-6 of the load."""
    model = contact_model(name, 3.0)
    bodies = pair(condyles(subdivisions=4), dished_insert(cells=24), material("polyethylene"))
    state, solutions = model.prepare(bodies), []

    def kept(*given):
        solutions.append(solve(*given))
        return solutions[-1]

    monkeypatch.setattr(lattice_model, "solve", kept)
    _, before = model.press_from(state, 1.5 * load, POSE)
    for start in (None, before):
        result = model.press(state, load, POSE, start)
        found, settings = solutions[-1], LatticeSolverSettings()
        force, missing = recomputed(state, found, load)
        size = np.linalg.norm(result.nodal_force)
        measured = found.residual
        assert result.status is ContactStatus.OK
        assert result.residual == max(measured.force, measured.gap)
        assert abs(max(force, measured.gap) - result.residual) * size < 1e-6 * load
        assert force <= settings.force_tolerance and missing < 1e-9
        assert measured.within(settings)
        assert (found.forces.force >= 0).all()
        assert gap_of(state, found, result.pose) <= measured.gap * (1 + 1e-6)


def worst(model, state, exact, wanted, rng, cases):
    """Return the largest errors of approach, peak and area over random presses and starts."""
    errors, starts = [], [None]
    for _ in range(cases):
        load, pose = np.exp(rng.uniform(0.0, np.log(24e3))), pose_of(rng)
        best = wanted.press(exact, load, pose)
        if best.status is not ContactStatus.OK:
            assert load > 20e3, load  # the reference itself finds no solution to 1e-6
            continue
        neighbour = pose.copy()
        neighbour[:3, 3] += [1e-4, 0.0, 0.0]
        kind = rng.integers(4)
        if kind == 0:
            start = None
        elif kind == 1:
            _, start = model.press_from(state, load, neighbour)
        elif kind == 2:
            _, start = model.press_from(state, min(4 * load, 24e3), pose)
        else:
            start = starts[-1]  # a wrong pose and another load
        found, end = model.press_from(state, load, pose, start)
        starts.append(end)
        assert found.status is ContactStatus.OK, (load, kind)
        sides = [
            sum(c.area for c in (one.medial, one.lateral) if c is not None) for one in (found, best)
        ]
        errors.append(
            [
                abs(found.approach / best.approach - 1),
                abs(found.pressure.max() / best.pressure.max() - 1),
                abs(sides[0] / sides[1] - 1),
                load,
                kind,
            ]
        )
    return np.array(errors)


def check(errors):
    for column, allowed in enumerate((5e-4, 1e-3, 2e-3)):
        worst_case = errors[np.argmax(errors[:, column])]
        assert worst_case[column] <= allowed, worst_case.tolist()


def test_the_answer_is_that_of_a_solution_to_1e_6_from_any_start(coarse):
    """Approach 5e-4, peak 1e-3, area 2e-3 from 1 N to 24 kN: a sample of the slow test."""
    wanted, exact = prepared(3.0, 1e-6)
    check(worst(*coarse, exact, wanted, np.random.default_rng(1), 12))


@pytest.mark.slow
@pytest.mark.parametrize("mm", [0.7, 1.0, 2.0, 3.0])
def test_two_hundred_presses_are_those_of_a_solution_to_1e_6(mm):
    """50 presses for each size of the cells."""
    wanted, exact = prepared(mm, 1e-6)
    check(worst(*prepared(mm), exact, wanted, np.random.default_rng(int(10 * mm)), 50))


def test_tolerances_are_needed(coarse):
    """A residual a hundred times as large leaves the approach further off than is allowed."""
    model, state = coarse
    best = model.press(state, 8e3, POSE)
    rough = replace(model, tolerance=0.1).press(state, 8e3, POSE)
    assert rough.residual > 2e-3
    assert abs(rough.approach / best.approach - 1) > 5e-4
