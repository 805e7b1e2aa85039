"""Hand calculations for one frame of the shipped knee bend: signs, units, rules."""

from dataclasses import replace

import numpy as np
import pytest

import tkamb.knee.equations as knee_module
from lattice_bodies import above, box_insert, pair, sphere_cap
from scenes import MODEL, fast_scene
from tkamb import simulate
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee.equations import EQUATION, solve_knee
from tkamb.knee.ligament_laws import QuadraticToe, TwoLine
from tkamb.knee.unknowns import CondylePoint, residuals
from tkamb.run.read_scene import recording_of

FRICTION = 0.05
ROWS = slice(30, 91, 30)


@pytest.fixture(scope="module")
def recording():
    return recording_of(load_case(load_scene(MODEL / "scene.toml")))


@pytest.fixture(scope="module")
def frame(recording):
    return recording.loads(60)


@pytest.fixture(scope="module")
def results():
    return simulate(fast_scene(), frames=ROWS)


def with_ground(geometry, point, force):
    """Return the frame with an additional ground force on the shank, insert frame."""
    ground = geometry.ground
    return replace(
        geometry,
        ground=replace(
            ground,
            points=np.concatenate([ground.points, [point]]),
            forces=np.concatenate([ground.forces, [force]]),
        ),
    )


@pytest.mark.parametrize(("force", "lever"), [
    ((0.0, 100.0, 0.0), (0.0, -0.4, -0.05)),
    ((0.0, 100.0, 0.0), (0.0, -0.4, 0.05)),
    ((0.0, 100.0, 0.0), (-0.08, -0.4, 0.0)),
    ((30.0, 0.0, 20.0), (0.02, -0.4, 0.01)),
])  # fmt: skip
def test_external_moments_are_force_times_lever(frame, force, lever):
    """The axes are the femoral ML axis and the floating axis through the femoral origin."""
    geometry, force = frame.geometry, np.array(force)
    femur = geometry.state.pose("femur")
    across, along = femur[:3, 2], np.array([0.0, 1.0, 0.0])
    floating = np.cross(along, across) / np.linalg.norm(np.cross(along, across))
    moment = np.cross(lever, force)
    before = solve_knee(geometry, FRICTION)
    after = solve_knee(with_ground(geometry, femur[:3, 3] + lever, force), FRICTION)
    change = after.external_adduction - before.external_adduction
    assert change == pytest.approx(moment @ floating, abs=1e-6)
    change = after.external_flexion - before.external_flexion
    assert change == pytest.approx(-moment @ across, abs=1e-6)


def test_a_ground_force_medial_of_the_knee_adducts_and_one_behind_it_flexes(frame):
    """Medial is -z, posterior is -x. 100 N have a moment of 5 N·m at 5 cm and 8 N·m at 8 cm."""
    origin = frame.geometry.state.pose("femur")[:3, 3]
    before = frame.loads
    up = np.array([0.0, 100.0, 0.0])
    medial = solve_knee(
        with_ground(frame.geometry, origin + np.array([0, -0.4, -0.05]), up), FRICTION
    )
    assert medial.external_adduction - before.external_adduction == pytest.approx(5.0, rel=0.02)
    behind = solve_knee(
        with_ground(frame.geometry, origin + np.array([-0.08, -0.4, 0]), up), FRICTION
    )
    assert behind.external_flexion - before.external_flexion == pytest.approx(8.0, rel=0.02)


def test_sensitivity_is_the_change_of_force_with_the_point_of_the_residuals(frame, monkeypatch):
    geometry = frame.geometry
    total = np.linalg.norm(solve_knee(geometry, FRICTION).contact_force)
    changes = []
    for shift in (-EQUATION.residual_shift, EQUATION.residual_shift):
        monkeypatch.setattr(
            knee_module.unknowns,
            "residuals",
            lambda point, *rest, s=shift: residuals(point + np.array([0.0, s, 0.0]), *rest),
        )
        moved = solve_knee(geometry, FRICTION)
        changes.append(np.linalg.norm(moved.contact_force) - total)
    monkeypatch.undo()
    assert abs(changes[0] - changes[1]) > 1e-3
    expected = max(map(abs, changes))
    assert solve_knee(geometry, FRICTION).sensitivity == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("side", ["medial", "lateral"])
def test_columns_of_area_and_pressure_have_the_units_of_their_names(results, side):
    """The map gives the triangles' area (mm²), the nodes' pressure (MPa) and the force (N)."""
    maps = results.maps
    corners = maps.points_m[maps.triangles]
    parallelogram_area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    nodal_area = np.zeros(len(maps.points_m))
    np.add.at(nodal_area, maps.triangles, (parallelogram_area / 6.0)[:, None])
    for k, pressure in enumerate(maps.pressure_Pa):
        inverse = np.linalg.inv(maps.femoral_pose[k])
        across = (maps.points_m @ inverse[2, :3]) + inverse[2, 3]
        loaded = (pressure > 0) & ((across < 0.0) == (side == "medial"))
        area, peak = nodal_area[loaded].sum() * 1e6, pressure[loaded].max() / 1e6
        assert results[f"{side}_area_mm2"][k] == pytest.approx(area, rel=0.03)
        assert results[f"{side}_peak_pressure_MPa"][k] == pytest.approx(peak, rel=1e-9)
        mean, force = results[f"{side}_mean_pressure_MPa"][k], results[f"{side}_force_N"][k]
        assert mean * results[f"{side}_area_mm2"][k] == pytest.approx(force, rel=1e-9)


def test_bundles_follow_the_published_toe_law():
    """Blankevoort et al. 1991, eps1 = 0.03: both branches give k eps1 at 6 %, a quarter at 3 %."""
    assert QuadraticToe(2000.0).tension(1.06, 1.0) == pytest.approx(60.0)
    assert QuadraticToe(2000.0).tension(1.03, 1.0) == pytest.approx(15.0)
    assert QuadraticToe(2000.0).tension(1.10, 1.0) == pytest.approx(140.0)
    assert TwoLine(5e4).tension(0.10 * 1.10, 0.10) == pytest.approx(5e4 * 0.10 * 0.07)


def test_the_source_s_rule_divides_by_the_overlap_of_the_undeformed_bodies():
    """A sphere that penetrates the flat insert by d has the contact area pi (2 R d - d²)."""
    radius, load = 20e-3, 700.0
    model = contact_model("lattice-linear", resolution=1e-3, pressure_rule="source", cache=False)
    bodies = pair(
        sphere_cap(radius), box_insert(20e-3, 8e-3, 20e-3), material("polyethylene-linear")
    )
    result = model.press(model.prepare(bodies), load, above())
    depth = result.approach
    overlap = np.pi * (2 * radius * depth - depth**2)
    loaded = result.pressure > 0
    assert result.area[loaded].sum() == pytest.approx(overlap, rel=0.06)
    vertical = -result.nodal_force[loaded] @ [0.0, 1.0, 0.0]
    expected = vertical * loaded.sum() / overlap
    np.testing.assert_allclose(result.pressure[loaded], expected, rtol=0.07)


def test_friction_opposes_the_sliding_of_the_femur():
    """In forward sliding with mu = 0.2, friction pulls back with 0.2 of the normal force."""
    up, forward = np.array([0.0, 1.0, 0.0]), np.array([0.1, 0.0, 0.0])
    force = CondylePoint(np.zeros(3), up, forward, 0.0).direction(0.2)
    np.testing.assert_allclose(force, [-0.2, 1.0, 0.0], atol=2e-5)
    still = CondylePoint(np.zeros(3), up, 0.03 * up, 0.0).direction(0.2)
    np.testing.assert_allclose(still, up)


def test_sliding_is_the_femur_s_velocity_at_the_contact(recording, frame):
    """Central differences of the recorded poses give the velocity in the insert frame."""
    time, poses = recording.motion.time, recording.poses
    for condyle in frame.geometry.condyles.values():
        on_femur = np.linalg.inv(poses[60]) @ np.append(condyle.point, 1.0)
        moved = [(poses[k] @ on_femur)[:3] for k in (59, 61)]
        velocity = (moved[1] - moved[0]) / (time[61] - time[59])
        assert np.linalg.norm(velocity) > 1e-3
        np.testing.assert_allclose(condyle.sliding, velocity, atol=0.02 * np.linalg.norm(velocity))
