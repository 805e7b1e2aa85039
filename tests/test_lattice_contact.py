"""Contact of the calibrated lattice: Hertz, conservation, Newton as reference, extremes."""

from dataclasses import replace

import numpy as np
import pytest

from lattice_bodies import above, box_insert, condyles, dished_insert, pair, plate, sphere_cap
from layer_contact import sphere_on_layer
from tkamb.contact.lattice import model as lattice_model
from tkamb.contact.lattice import nonlinear_balance, solver
from tkamb.contact.lattice.active_set import solve_contact
from tkamb.contact.lattice.problem import tangent_planes
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus
from tkamb.geometry.frames import knee_pose
from tkamb.studies.extremes import extremes
from tkamb.testing import check_contact_model

E, NU, RADIUS = 561.5e6, 0.45, 22e-3
LINEAR, POLYETHYLENE = material("polyethylene-linear"), material("polyethylene")
OFFSETS = [(0, 0), (0.5, 0.5), (0.5, 0), (0.25, 0.25), (0.13, 0.37), (0.4, 0.1), (0.3, 0.45),
           (0.2, 0.05)]  # fmt: skip


def hertz_errors(width, height, size, offsets):
    """Return L2 and peak pressure errors, one row per sub-cell offset."""
    model = contact_model("lattice-linear", size * 1e3)
    state = model.prepare(pair(sphere_cap(RADIUS), box_insert(width, height, width), LINEAR))
    a, _, middles, exact = sphere_on_layer(RADIUS, height, 500.0, E, NU)
    rows = []
    for x, z in np.array(offsets) * size:
        result = model.press(state, 500.0, above(x, z))
        away = np.hypot(result.points[:, 0] - x, result.points[:, 2] - z)
        wanted = np.interp(away, [0, *middles, a], [exact[0], *exact, 0], right=0)
        square = (result.pressure - wanted) ** 2 @ result.area
        rows.append(
            (np.sqrt(square / (wanted**2 @ result.area)), result.pressure.max() / exact[0] - 1)
        )
    return np.array(rows)


def test_reference_layer_tends_to_hertz():
    a, approach, _, pressure = sphere_on_layer(RADIUS, 1.0, 500.0, E, NU)
    exact = (3 * 500 * RADIUS * (1 - NU**2) / (4 * E)) ** (1 / 3)
    assert a == pytest.approx(exact, rel=1e-3)
    assert pressure[0] == pytest.approx(1.5 * 500 / np.pi / exact**2, rel=1e-3)
    assert approach == pytest.approx(exact**2 / RADIUS, rel=3e-3)


def test_hertz_pressure_at_one_millimetre():
    """Peak within 3 %, L2 within 10 %, both as means over eight sub-cell offsets."""
    errors = hertz_errors(16e-3, 8e-3, 1e-3, OFFSETS)
    assert errors[:, 0].mean() < 0.10
    assert abs(errors[:, 1].mean()) < 0.03
    assert np.abs(errors[:, 1]).max() < 0.05


@pytest.mark.slow
def test_hertz_pressure_converges():
    """L2 falls with the cells, to 4 % at 0.4 mm; peak within 3 %."""
    sizes = [1e-3, 0.5e-3, 0.4e-3]
    errors = [hertz_errors(12e-3, 8e-3, size, OFFSETS) for size in sizes]
    mean = [e[:, 0].mean() for e in errors]
    assert np.polyfit(np.log(sizes), np.log(mean), 1)[0] > 0.6
    assert mean[-1] < 0.04
    assert np.abs(errors[-1][:, 1]).max() < 0.03


def test_plate_on_box_agrees_with_finite_elements():
    """1000 N on 12 x 12 x 3 mm: max and min pressure within 2 % on the same 1 mm grid."""
    found = {}
    for name in ("lattice-linear", "fe"):
        model = contact_model(name, 1.0)
        state = model.prepare(pair(plate(20e-3, 20e-3), box_insert(12e-3, 3e-3, 12e-3), LINEAR))
        found[name] = model.press(state, 1000.0, above())
    ours, fe = found["lattice-linear"], found["fe"]
    assert (ours.pressure > 0).all()
    assert ours.pressure.max() == pytest.approx(fe.pressure.max(), rel=0.02)
    assert ours.pressure.min() == pytest.approx(fe.pressure.min(), rel=0.02)
    assert fe.pressure.max() == pytest.approx(9.11e6, rel=0.01)


def test_plate_approach_converges_with_the_cells():
    """Against 0.5 mm finite elements extrapolated: the error falls at first order or better."""
    sizes, found = np.array([1.5, 1.0, 0.75]), []
    insert = box_insert(12e-3, 3e-3, 12e-3)
    for size in sizes:
        model = contact_model("lattice-linear", size)
        state = model.prepare(pair(plate(20e-3, 20e-3), insert, LINEAR))
        found.append(model.press(state, 1000.0, above()).approach)
    error = 0.0257e-3 - np.array(found)
    assert np.polyfit(np.log(sizes), np.log(error), 1)[0] > 0.9


@pytest.mark.parametrize("name", ["lattice", "fe", "lattice-source"])
@pytest.mark.parametrize("load", [1.0, 800.0, 4000.0])
def test_accelerated_iteration_agrees_with_newton(name, load):
    """Approach, peak and condyle forces within 1 % of full Newton at a tight tolerance."""
    femoral, insert = condyles(subdivisions=4), dished_insert(cells=24)
    pose = knee_pose([1e-3, 0.0, 0.3e-3, 0.0, np.radians(0.3), 0.0])
    model = contact_model(name, 3.0)
    state = model.prepare(pair(femoral, insert, POLYETHYLENE))
    fast = model.press(state, load, pose)
    exact = contact_model(name, 3.0, newton=True, tolerance=1e-5).press(state, load, pose)
    assert fast.status is exact.status is ContactStatus.OK
    assert fast.approach == pytest.approx(exact.approach, rel=0.01)
    assert fast.pressure.max() == pytest.approx(exact.pressure.max(), rel=0.01)
    assert -fast.wrench_on_insert[1] == pytest.approx(load, rel=1e-6)
    if exact.medial and exact.lateral:
        assert fast.medial.force == pytest.approx(exact.medial.force, rel=0.01)


@pytest.mark.parametrize("name", ["lattice", "lattice-linear"])
def test_a_contact_that_outgrows_its_candidates_is_solved_again(name, monkeypatch):
    """From a start for less load; with too few candidates a deep contact would be too soft."""
    begun, first_guess = [], lattice_model.initial_guess

    def counted(*given):
        begun.append(given)
        return first_guess(*given)

    monkeypatch.setattr(lattice_model, "initial_guess", counted)
    model = contact_model(name, 2.0)
    state = model.prepare(pair(condyles(subdivisions=4), dished_insert(cells=24), POLYETHYLENE))
    pose = knee_pose([1e-3, 0.0, 0.3e-3, 0.0, 0.0, 0.0])

    def pressed(load, start=None):
        begun.clear()
        return model.press(state, load, pose, start), len(begun)

    _, light = model.press_from(state, 800.0, pose)
    for load in (820.0, 4000.0):
        alone, _ = pressed(load)
        after, solved = pressed(load, light)
        assert (solved > 1) is (load == 4000.0)
        assert after.approach == pytest.approx(alone.approach, rel=1e-3)
        assert after.pressure == pytest.approx(alone.pressure, abs=2e-3 * alone.pressure.max())
    monkeypatch.setattr(lattice_model, "COVERED_APPROACH", 1e-9)
    wrong, _ = pressed(4000.0, light)
    assert wrong.approach > 1.02 * alone.approach


def test_newton_is_not_asked_about_a_contact_that_has_outgrown_its_candidates(monkeypatch):
    """It is solved again with more of them first, and the answer is that of the load alone."""
    model = contact_model("lattice", 2.0)
    state = model.prepare(pair(condyles(subdivisions=4), dished_insert(cells=24), POLYETHYLENE))
    pose = knee_pose([1e-3, 0.0, 0.3e-3, 0.0, 0.0, 0.0])
    alone, begin = model.press_from(state, 4000.0, pose)
    _, light = model.press_from(state, 800.0, pose)
    solve, given = lattice_model.solve, []

    def swinging_at_first(*guess):
        given.append(guess)
        found = solve(*guess)
        if len(given) > 1:
            return found
        return replace(found, forces=replace(found.forces, converged=False))

    def asked(*guess):
        raise AssertionError("Newton's method was asked")

    monkeypatch.setattr(lattice_model, "solve", swinging_at_first)
    monkeypatch.setattr(lattice_model, "solve_by_newton", asked)
    after = model.press(state, 4000.0, pose, light)
    assert after.status is ContactStatus.OK and len(given) > 1
    assert after.approach == pytest.approx(alone.approach, rel=1e-3)
    given.clear()
    with pytest.raises(AssertionError, match="was asked"):
        model.press(state, 4000.0, pose, begin)


def test_active_nodes_end_on_the_femoral_surface():
    """Within the gap tolerance, by rays fired anew, on a rough femoral component."""
    label = "load_N=20000.0, rough_mm=0.01"
    rough = next(x for x in extremes() if (x.model, x.label) == ("lattice", label))
    model = contact_model("lattice", rough.resolution_mm)
    state = model.prepare(rough.pair)
    found, start = model.press_from(state, 15e3, rough.pose)
    assert found.status is ContactStatus.OK
    touching = found.pressure > 0
    moved = start.displacement[touching]
    there = state.problem.surface_points[touching] + moved
    gap = tangent_planes(state.problem, there, found.pose, None).gap(there)
    assert np.abs(gap).max() / np.abs(moved).max() <= 4 * model.settings.gap_tolerance


def test_a_contact_that_has_softened_is_held_closer(monkeypatch):
    """Approach and peak of heavy loads against a solution to 1e-5, from rest and from others."""
    bodies = pair(condyles(subdivisions=4), dished_insert(cells=24), POLYETHYLENE)
    pose = knee_pose([1e-3, 0.0, 0.3e-3, 0.0, 0.0, 0.0])
    model, fine = (contact_model("lattice", 2.0, tolerance=x) for x in (1e-3, 1e-5))
    state, exact = model.prepare(bodies), fine.prepare(bodies)
    wanted = {load: fine.press(exact, load, pose) for load in (8e3, 16e3)}
    starts = {load: model.press_from(state, load, pose)[1] for load in (800.0, 15e3)}

    def errors(load, start=None):
        found = model.press(state, load, pose, starts.get(start))
        assert found.status is ContactStatus.OK
        approach = found.approach / wanted[load].approach - 1
        return abs(approach), abs(found.pressure.max() / wanted[load].pressure.max() - 1)

    ways = [(8e3, None), (8e3, 800.0), (16e3, None), (16e3, 800.0), (16e3, 15e3)]
    for way in ways:
        approach, peak = errors(*way)
        assert approach < 5e-4 and peak < 1e-3, way
    loose = replace(model.settings, work_tolerance=np.inf)  # the force alone is held
    monkeypatch.setattr(type(model), "settings", loose)
    assert max(errors(*way)[0] for way in ways) > 5e-4


@pytest.mark.parametrize("cause", ["surface", "forces"])
def test_newton_is_asked_where_forces_stay_out_of_balance(cause, monkeypatch):
    """Of a femoral surface on which no node rests its answer would be the same."""
    asked, by_newton = [], lattice_model.solve_by_newton
    gap_of = solver.SlidingNodes._relative_gap

    def counted(*given):
        asked.append(cause)
        return by_newton(*given)

    monkeypatch.setattr(lattice_model, "solve_by_newton", counted)
    if cause == "surface":
        never = lambda *given: max(gap_of(*given), 0.1)  # noqa: E731
        monkeypatch.setattr(solver.SlidingNodes, "_relative_gap", never)
    else:
        monkeypatch.setattr(nonlinear_balance.NonlinearBalance, "advance", lambda self: None)
    model = contact_model("lattice", 3.0)
    state = model.prepare(pair(condyles(subdivisions=4), dished_insert(cells=24), POLYETHYLENE))
    result = model.press(state, 800.0, knee_pose([1e-3, 0.0, 0.3e-3, 0.0, 0.0, 0.0]))
    if cause == "surface":
        assert not asked
        assert result.status is ContactStatus.NOT_CONVERGED
    else:
        assert asked
        assert result.status is ContactStatus.OK


@pytest.mark.parametrize("name", ["lattice", "lattice-linear", "fe", "lattice-source"])
def test_models_keep_the_contract(name):
    check_contact_model(contact_model(name, 2.0))


@pytest.mark.parametrize("bearing", ["fixed", "mobile"])
def test_symmetric_press_is_shared_evenly(bearing):
    model = contact_model("lattice", 2.0)
    state = model.prepare(
        pair(condyles(subdivisions=4), dished_insert(cells=24), POLYETHYLENE, bearing)
    )
    result = model.press(state, 1500.0, knee_pose(np.zeros(6)))
    assert result.status is ContactStatus.OK
    assert result.medial.force == pytest.approx(result.lateral.force, rel=0.02)
    assert np.abs(result.wrench_on_insert[[0, 2]]).max() < 0.01 * 1500


def test_forces_act_along_the_femoral_normal():
    """On a sphere every force points away from its centre, at the displaced node."""
    model = contact_model("lattice", 2.0)
    state = model.prepare(pair(sphere_cap(RADIUS), box_insert(20e-3, 8e-3, 20e-3), POLYETHYLENE))
    result = model.press(state, 800.0, above(0.7e-3, -0.4e-3))
    loaded = result.pressure > 0
    force = result.nodal_force[loaded]
    away = result.points[loaded] - result.pose[:3, 3]
    sine = np.linalg.norm(np.cross(force, away), axis=1)
    sine /= np.linalg.norm(force, axis=1) * np.linalg.norm(away, axis=1)
    assert sine.max() < 0.02


@pytest.mark.parametrize("name", ["lattice", "lattice-linear"])
@pytest.mark.parametrize("nu", [0.0, 0.25, 0.4999])
@pytest.mark.parametrize("load", [1e-3, 1.0, 1e3, 1e4])
def test_extreme_loads_and_ratios_are_answered_or_flagged(name, nu, load):
    model = contact_model(name, 3.0)
    mat = material("polyethylene", poisson_ratio=nu)
    state = model.prepare(pair(condyles(subdivisions=4), dished_insert(cells=24), mat))
    result = model.press(state, load, knee_pose([0, 0, 0, 0, np.radians(5), 0]))
    if result.status is ContactStatus.OK:
        assert -result.wrench_on_insert[1] == pytest.approx(load, rel=1e-5)
        assert np.isfinite(result.pressure).all()
    else:
        assert result.flags


def test_thirty_kilonewtons_are_flagged_or_refused():
    model = contact_model("lattice", 3.0)
    state = model.prepare(pair(condyles(subdivisions=4), dished_insert(cells=24), POLYETHYLENE))
    result = model.press(state, 3e4, knee_pose(np.zeros(6)))
    assert result.status is ContactStatus.OUT_OF_RANGE or any("strain" in f for f in result.flags)


def test_source_loops_give_the_stored_answer():
    """The linear shortcut and the nonlinear secant loop against the stored response."""
    for law in ("linear", "nonlinear"):
        results = []
        for loops in ("stored", "source"):
            model = contact_model("lattice-source", 2.0, law=law, loops=loops, tolerance=1e-4)
            bodies = pair(sphere_cap(RADIUS), box_insert(14e-3, 6e-3, 14e-3), POLYETHYLENE)
            results.append(model.press(model.prepare(bodies), 800.0, above()))
        stored, source = results
        assert stored.status is source.status is ContactStatus.OK
        assert source.approach == pytest.approx(stored.approach, rel=1e-3)
        assert source.pressure == pytest.approx(stored.pressure, rel=2e-3, abs=1e4)


def test_source_pressure_rule_shares_the_overlap_evenly():
    """Sum of p A = F n with A = overlap / N."""
    model = contact_model("lattice-linear", 1.5, pressure_rule="source")
    bodies = pair(sphere_cap(RADIUS), box_insert(20e-3, 8e-3, 20e-3), LINEAR)
    result = model.press(model.prepare(bodies), 500.0, above())
    loaded = result.pressure > 0
    assert np.ptp(result.area[loaded]) == 0
    assert (result.pressure * result.area)[loaded].sum() == pytest.approx(500, rel=1e-6)


def test_active_set_solves_the_complementarity():
    generator = np.random.default_rng(3)
    for _ in range(20):
        root = generator.normal(size=(25, 25))
        compliance = root @ root.T + 0.5 * np.eye(25)
        gap, lean = generator.uniform(0, 5, 25), -generator.uniform(0.5, 1, 25)
        for load in (None, 3.0):
            found = solve_contact(compliance, gap, lean, load, np.zeros(25, bool), 4.0)
            opening = gap + compliance @ found.force + found.approach * lean
            assert found.converged
            assert found.force.min() >= 0
            assert opening.min() > -1e-9
            assert np.abs(opening * found.force).max() < 1e-8
            if load is not None:
                assert -lean @ found.force == pytest.approx(load)
