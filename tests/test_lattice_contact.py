"""Contact of the lattice models: Hertz, equilibrium, full Newton iteration, extreme loads."""

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
from tkamb.studies.cases import extremes

E, NU, RADIUS = 561.5e6, 0.45, 22e-3
LINEAR, POLYETHYLENE = material("polyethylene-linear"), material("polyethylene")
OFFSETS = [(0, 0), (0.5, 0.5), (0.5, 0), (0.25, 0.25), (0.13, 0.37), (0.4, 0.1), (0.3, 0.45),
           (0.2, 0.05)]  # fmt: skip


def hertz_errors(width, height, size, offsets):
    """Return relative L2 and peak errors of the pressure, one row per sub-cell offset."""
    model = contact_model("lattice-linear", resolution=size * 1e3 * 1e-3)
    state = model.prepare(pair(sphere_cap(RADIUS), box_insert(width, height, width), LINEAR))
    a, _, middles, exact = sphere_on_layer(RADIUS, height, 500.0, E, NU)
    rows = []
    for x, z in np.array(offsets) * size:
        result = model.press(state, 500.0, above(x, z))
        radius = np.hypot(result.points[:, 0] - x, result.points[:, 2] - z)
        expected = np.interp(radius, [0, *middles, a], [exact[0], *exact, 0], right=0)
        square = (result.pressure - expected) ** 2 @ result.area
        rows.append(
            (np.sqrt(square / (expected**2 @ result.area)), result.pressure.max() / exact[0] - 1)
        )
    return np.array(rows)


def test_sphere_on_a_thick_layer_agrees_with_hertz():
    a, approach, _, pressure = sphere_on_layer(RADIUS, 1.0, 500.0, E, NU)
    exact = (3 * 500 * RADIUS * (1 - NU**2) / (4 * E)) ** (1 / 3)
    assert a == pytest.approx(exact, rel=1e-3)
    assert pressure[0] == pytest.approx(1.5 * 500 / np.pi / exact**2, rel=1e-3)
    assert approach == pytest.approx(exact**2 / RADIUS, rel=3e-3)


def test_hertz_pressure_at_one_millimetre_is_accurate():
    """The mean error over eight sub-cell offsets is below 3 % (peak) and 10 % (L2)."""
    errors = hertz_errors(16e-3, 8e-3, 1e-3, OFFSETS)
    assert errors[:, 0].mean() < 0.10
    assert abs(errors[:, 1].mean()) < 0.03
    assert np.abs(errors[:, 1]).max() < 0.05


@pytest.mark.slow
def test_hertz_pressure_converges():
    """At 0.4 mm the L2 error is below 4 %, and the peak is within 3 %."""
    sizes = [1e-3, 0.5e-3, 0.4e-3]
    errors = [hertz_errors(12e-3, 8e-3, size, OFFSETS) for size in sizes]
    mean = [e[:, 0].mean() for e in errors]
    assert np.polyfit(np.log(sizes), np.log(mean), 1)[0] > 0.6
    assert mean[-1] < 0.04
    assert np.abs(errors[-1][:, 1]).max() < 0.03


def test_plate_on_box_agrees_with_finite_elements():
    """1000 N on 12 x 12 x 3 mm at 1 mm: largest and smallest pressures agree within 2 %."""
    results = {}
    for name in ("lattice-linear", "fe"):
        model = contact_model(name, resolution=1e-3)
        state = model.prepare(pair(plate(20e-3, 20e-3), box_insert(12e-3, 3e-3, 12e-3), LINEAR))
        results[name] = model.press(state, 1000.0, above())
    lattice, fe = results["lattice-linear"], results["fe"]
    assert (lattice.pressure > 0).all()
    assert lattice.pressure.max() == pytest.approx(fe.pressure.max(), rel=0.02)
    assert lattice.pressure.min() == pytest.approx(fe.pressure.min(), rel=0.02)
    assert fe.pressure.max() == pytest.approx(9.11e6, rel=0.01)


def test_plate_approach_converges_with_the_cells():
    """The reference is extrapolated from finite elements. The error falls at first order."""
    sizes, approaches = np.array([1.5, 1.0, 0.75]), []
    insert = box_insert(12e-3, 3e-3, 12e-3)
    for size in sizes:
        model = contact_model("lattice-linear", resolution=size * 1e-3)
        state = model.prepare(pair(plate(20e-3, 20e-3), insert, LINEAR))
        approaches.append(model.press(state, 1000.0, above()).approach)
    error = 0.0257e-3 - np.array(approaches)
    assert np.polyfit(np.log(sizes), np.log(error), 1)[0] > 0.9


@pytest.mark.parametrize("name", ["lattice", "fe", "lattice-source"])
@pytest.mark.parametrize("load", [1.0, 800.0, 4000.0])
def test_accelerated_iteration_agrees_with_newton(name, load):
    """Approach, peak and condyle forces are within 1 % of full Newton with a small tolerance."""
    femoral, insert = condyles(subdivisions=4), dished_insert(cells=24)
    pose = knee_pose([1e-3, 0.0, 0.3e-3, 0.0, np.radians(0.3), 0.0])
    model = contact_model(name, resolution=3e-3)
    state = model.prepare(pair(femoral, insert, POLYETHYLENE))
    fast = model.press(state, load, pose)
    exact = contact_model(name, resolution=3e-3, newton=True, tolerance=1e-5).press(
        state, load, pose
    )
    assert fast.status is exact.status is ContactStatus.OK
    assert fast.approach == pytest.approx(exact.approach, rel=0.01)
    assert fast.pressure.max() == pytest.approx(exact.pressure.max(), rel=0.01)
    assert -fast.wrench_on_insert[1] == pytest.approx(load, rel=1e-6)
    if exact.medial and exact.lateral:
        assert fast.medial.force == pytest.approx(exact.medial.force, rel=0.01)


@pytest.mark.parametrize("name", ["lattice", "lattice-linear"])
def test_a_contact_with_too_few_candidates_is_solved_again(name, monkeypatch):
    """A warm start for a small load has few candidates, with which a large load sinks too far."""
    guesses, initial_guess = [], lattice_model.initial_guess

    def counting(*arguments):
        guesses.append(arguments)
        return initial_guess(*arguments)

    monkeypatch.setattr(lattice_model, "initial_guess", counting)
    model = contact_model(name, resolution=2e-3)
    state = model.prepare(pair(condyles(subdivisions=4), dished_insert(cells=24), POLYETHYLENE))
    pose = knee_pose([1e-3, 0.0, 0.3e-3, 0.0, 0.0, 0.0])

    def press_and_count(load, start=None):
        guesses.clear()
        return model.press(state, load, pose, start), len(guesses)

    _, light = model.press_from(state, 800.0, pose)
    for load in (820.0, 4000.0):
        cold, _ = press_and_count(load)
        warm, count = press_and_count(load, light)
        assert (count > 1) is (load == 4000.0)
        assert warm.approach == pytest.approx(cold.approach, rel=1e-3)
        assert warm.pressure == pytest.approx(cold.pressure, abs=2e-3 * cold.pressure.max())
    monkeypatch.setattr(lattice_model, "COVERED_APPROACH", 1e-9)
    wrong, _ = press_and_count(4000.0, light)
    assert wrong.approach > 1.02 * cold.approach


def test_candidates_are_added_before_newton_s_method_is_tried(monkeypatch):
    """The result is then that of a cold start."""
    model = contact_model("lattice", resolution=2e-3)
    state = model.prepare(pair(condyles(subdivisions=4), dished_insert(cells=24), POLYETHYLENE))
    pose = knee_pose([1e-3, 0.0, 0.3e-3, 0.0, 0.0, 0.0])
    cold, heavy = model.press_from(state, 4000.0, pose)
    _, light = model.press_from(state, 800.0, pose)
    solve, calls = lattice_model.solve, []

    def unconverged_at_first(*arguments):
        calls.append(arguments)
        solution = solve(*arguments)
        if len(calls) > 1:
            return solution
        return replace(solution, forces=replace(solution.forces, converged=False))

    def fail(*arguments):
        raise AssertionError("Newton's method was called")

    monkeypatch.setattr(lattice_model, "solve", unconverged_at_first)
    monkeypatch.setattr(lattice_model, "solve_by_newton", fail)
    warm = model.press(state, 4000.0, pose, light)
    assert warm.status is ContactStatus.OK and len(calls) > 1
    assert warm.approach == pytest.approx(cold.approach, rel=1e-3)
    calls.clear()
    with pytest.raises(AssertionError, match="was called"):
        model.press(state, 4000.0, pose, heavy)


def test_active_nodes_end_on_the_femoral_surface():
    """New rays give gaps within four tolerances, on a rough femoral component."""
    label = "load_N=20000.0, rough_mm=0.01"
    rough = next(x for x in extremes() if (x.model, x.label) == ("lattice", label))
    model = contact_model("lattice", resolution=rough.resolution_mm * 1e-3)
    state = model.prepare(rough.pair)
    result, start = model.press_from(state, 15e3, rough.pose)
    assert result.status is ContactStatus.OK
    active = result.pressure > 0
    displacement = start.displacement[active]
    positions = state.problem.surface_points[active] + displacement
    gap = tangent_planes(state.problem, positions, result.pose, None).gap(positions)
    assert np.abs(gap).max() / np.abs(displacement).max() <= 4 * model.settings.gap_tolerance


def test_work_and_peak_tolerance_keep_heavy_loads_accurate(monkeypatch):
    """Approach and peak from cold and warm starts, compared with a tolerance of 1e-5."""
    bodies = pair(condyles(subdivisions=4), dished_insert(cells=24), POLYETHYLENE)
    pose = knee_pose([1e-3, 0.0, 0.3e-3, 0.0, 0.0, 0.0])
    model, fine = (contact_model("lattice", resolution=2e-3, tolerance=x) for x in (1e-3, 1e-5))
    state, exact = model.prepare(bodies), fine.prepare(bodies)
    expected = {load: fine.press(exact, load, pose) for load in (8e3, 16e3)}
    starts = {load: model.press_from(state, load, pose)[1] for load in (800.0, 15e3)}

    def errors(load, start=None):
        result = model.press(state, load, pose, starts.get(start))
        assert result.status is ContactStatus.OK
        approach = result.approach / expected[load].approach - 1
        return abs(approach), abs(result.pressure.max() / expected[load].pressure.max() - 1)

    cases = [(8e3, None), (8e3, 800.0), (16e3, None), (16e3, 800.0), (16e3, 15e3)]
    for case in cases:
        approach, peak = errors(*case)
        assert approach < 5e-4 and peak < 1e-3, case
    loose = replace(model.settings, work_tolerance=np.inf, peak_tolerance=np.inf)
    monkeypatch.setattr(type(model), "settings", loose)
    assert max(errors(*case)[0] for case in cases) > 5e-4


@pytest.mark.parametrize("cause", ["surface", "forces"])
def test_newton_s_method_follows_unbalanced_forces_but_not_gaps(cause, monkeypatch):
    """Where nodes oscillate on the femoral surface, Newton's method would oscillate too."""
    calls, solve_by_newton = [], lattice_model.solve_by_newton
    relative_gap = solver.SlidingNodes._relative_gap

    def counting(*arguments):
        calls.append(cause)
        return solve_by_newton(*arguments)

    monkeypatch.setattr(lattice_model, "solve_by_newton", counting)
    if cause == "surface":
        large_gap = lambda *arguments: max(relative_gap(*arguments), 0.1)  # noqa: E731
        monkeypatch.setattr(solver.SlidingNodes, "_relative_gap", large_gap)
    else:
        monkeypatch.setattr(nonlinear_balance.NonlinearBalance, "advance", lambda self: None)
    model = contact_model("lattice", resolution=3e-3)
    state = model.prepare(pair(condyles(subdivisions=4), dished_insert(cells=24), POLYETHYLENE))
    result = model.press(state, 800.0, knee_pose([1e-3, 0.0, 0.3e-3, 0.0, 0.0, 0.0]))
    if cause == "surface":
        assert not calls
        assert result.status is ContactStatus.NOT_CONVERGED
    else:
        assert calls
        assert result.status is ContactStatus.OK


@pytest.mark.parametrize("bearing", ["fixed", "mobile"])
def test_condyles_share_the_load_of_a_symmetric_press(bearing):
    model = contact_model("lattice", resolution=2e-3)
    state = model.prepare(
        pair(condyles(subdivisions=4), dished_insert(cells=24), POLYETHYLENE, bearing)
    )
    result = model.press(state, 1500.0, knee_pose(np.zeros(6)))
    assert result.status is ContactStatus.OK
    assert result.medial.force == pytest.approx(result.lateral.force, rel=0.02)
    assert np.abs(result.wrench_on_insert[[0, 2]]).max() < 0.01 * 1500


def test_forces_act_along_the_femoral_normal():
    """On a sphere, every force points away from the centre."""
    model = contact_model("lattice", resolution=2e-3)
    state = model.prepare(pair(sphere_cap(RADIUS), box_insert(20e-3, 8e-3, 20e-3), POLYETHYLENE))
    result = model.press(state, 800.0, above(0.7e-3, -0.4e-3))
    loaded = result.pressure > 0
    force = result.nodal_force[loaded]
    radius = result.points[loaded] - result.pose[:3, 3]
    sine = np.linalg.norm(np.cross(force, radius), axis=1)
    sine /= np.linalg.norm(force, axis=1) * np.linalg.norm(radius, axis=1)
    assert sine.max() < 0.02


@pytest.mark.parametrize("name", ["lattice", "lattice-linear"])
@pytest.mark.parametrize("nu", [0.0, 0.4999])
@pytest.mark.parametrize("load", [1e-3, 1.0, 1e3, 1e4])
def test_extreme_loads_and_poisson_ratios_give_a_result_or_a_flag(name, nu, load):
    model = contact_model(name, resolution=3e-3)
    mat = material("polyethylene", poisson_ratio=nu)
    state = model.prepare(pair(condyles(subdivisions=4), dished_insert(cells=24), mat))
    result = model.press(state, load, knee_pose([0, 0, 0, 0, np.radians(5), 0]))
    if result.status is ContactStatus.OK:
        assert -result.wrench_on_insert[1] == pytest.approx(load, rel=1e-5)
        assert np.isfinite(result.pressure).all()
    else:
        assert result.flags


def test_thirty_kilonewtons_are_flagged_or_out_of_range():
    model = contact_model("lattice", resolution=3e-3)
    state = model.prepare(pair(condyles(subdivisions=4), dished_insert(cells=24), POLYETHYLENE))
    result = model.press(state, 3e4, knee_pose(np.zeros(6)))
    assert result.status is ContactStatus.OUT_OF_RANGE or any("strain" in f for f in result.flags)


def test_source_loops_agree_with_the_default_solver():
    for law in ("linear", "nonlinear"):
        results = []
        for loops in ("stored", "source"):
            model = contact_model(
                "lattice-source", resolution=2e-3, law=law, loops=loops, tolerance=1e-4
            )
            bodies = pair(sphere_cap(RADIUS), box_insert(14e-3, 6e-3, 14e-3), POLYETHYLENE)
            results.append(model.press(model.prepare(bodies), 800.0, above()))
        stored, source = results
        assert stored.status is source.status is ContactStatus.OK
        assert source.approach == pytest.approx(stored.approach, rel=1e-3)
        assert source.pressure == pytest.approx(stored.pressure, rel=2e-3, abs=1e4)


def test_source_pressure_rule_shares_the_overlap_evenly():
    """Nodes in contact have equal areas. The sum of p A is the load."""
    model = contact_model("lattice-linear", resolution=1.5e-3, pressure_rule="source")
    bodies = pair(sphere_cap(RADIUS), box_insert(20e-3, 8e-3, 20e-3), LINEAR)
    result = model.press(model.prepare(bodies), 500.0, above())
    loaded = result.pressure > 0
    assert np.ptp(result.area[loaded]) == 0
    assert (result.pressure * result.area)[loaded].sum() == pytest.approx(500, rel=1e-6)


def test_active_set_fulfils_the_contact_conditions():
    generator = np.random.default_rng(3)
    for _ in range(20):
        root = generator.normal(size=(25, 25))
        compliance = root @ root.T + 0.5 * np.eye(25)
        gap, normal_y = generator.uniform(0, 5, 25), -generator.uniform(0.5, 1, 25)
        for load in (None, 3.0):
            forces = solve_contact(compliance, gap, normal_y, load, np.zeros(25, bool), 4.0)
            opening = gap + compliance @ forces.force + forces.approach * normal_y
            assert forces.converged
            assert forces.force.min() >= 0
            assert opening.min() > -1e-9
            assert np.abs(opening * forces.force).max() < 1e-8
            if load is not None:
                assert -normal_y @ forces.force == pytest.approx(load)
