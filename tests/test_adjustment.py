"""Femoral adjustment: correction of the recorded pose, its limits, and the restored rotation."""

from functools import cache
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tkamb.contact.materials import material
from tkamb.contact.model import ContactModel
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactResult
from tkamb.errors import InputError
from tkamb.geometry.adjustment import Adjustment, AdjustmentSettings, RestoreRule, adjust
from tkamb.geometry.closest import ClosestPointQuery
from tkamb.geometry.frames import Array, pose, transform
from tkamb.geometry.surface import Surface
from tkamb.knee.adjustment import press_adjusted

RADIUS, HALF = 0.02, 0.022
HEIGHT = 1.5e-4


def insert() -> Surface:
    box = trimesh.creation.box(extents=(0.05, 0.01, 0.08))
    mesh = box.apply_translation([0.0, 0.005, 0.0])
    for _ in range(3):
        mesh = mesh.subdivide()
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), "insert")


def condyles() -> Surface:
    """Return two spheres of 20 mm radius, 44 mm apart."""
    parts = []
    for side in (-1.0, 1.0):
        ball = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
        parts.append(ball.apply_translation([0.0, RADIUS, side * HALF]))
    mesh = trimesh.util.concatenate(parts)
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), "femoral")


@pytest.fixture(scope="module")
def query() -> ClosestPointQuery:
    return ClosestPointQuery(condyles(), insert(), 0.0)


def tilted(angle_deg: float, height: float = 3e-4) -> Array:
    """Return the femur's pose, turned about x, with its middle `height` above touch on a flat
    insert.
    """
    rotation = Rotation.from_euler("x", angle_deg, degrees=True).as_matrix()
    return pose(rotation, [0.0, 0.01 + height, 0.0])


@pytest.mark.parametrize("angle_deg", [0.4, -0.4, 0.1])
def test_a_small_coronal_angle_is_corrected(query: ClosestPointQuery, angle_deg: float) -> None:
    adjustment = adjust(query, tilted(angle_deg))
    assert np.rad2deg(adjustment.coronal_angle) == pytest.approx(-angle_deg, abs=0.01)
    assert np.rad2deg(adjustment.measured_angle) == pytest.approx(-angle_deg, abs=0.02)
    medial, lateral = (gap.gap for gap in vars(query.at(adjustment.pose)).values())
    assert medial == pytest.approx(0.0, abs=2e-6)
    assert lateral == pytest.approx(0.0, abs=2e-6)


@pytest.mark.parametrize("angle_deg", [0.6, -0.6])
def test_a_large_coronal_angle_is_lift_off_and_not_corrected(
    query: ClosestPointQuery, angle_deg: float
) -> None:
    adjustment = adjust(query, tilted(angle_deg))
    assert adjustment.coronal_angle == 0.0
    assert adjustment.pose[:3, :3] == pytest.approx(tilted(angle_deg)[:3, :3])
    gaps = sorted(gap.gap for gap in vars(query.at(adjustment.pose)).values())
    assert gaps[0] == pytest.approx(0.0, abs=2e-6)
    assert gaps[1] == pytest.approx(2 * HALF * np.deg2rad(0.6), rel=0.02)


@pytest.mark.parametrize("angle_deg", [0.4, -0.3])
def test_the_turn_does_not_move_the_components_centre(
    query: ClosestPointQuery, angle_deg: float
) -> None:
    recorded = tilted(angle_deg)
    adjustment = adjust(query, recorded)
    centre = query.femoral.bounds.mean(axis=0)
    before, after = (
        transform(femoral_pose, centre) for femoral_pose in (recorded, adjustment.pose)
    )
    np.testing.assert_allclose(
        after, before + np.array([0.0, adjustment.translation, 0.0]), atol=1e-12
    )


def on_a_flank(depth: float) -> ClosestPointQuery:
    """Return a query: medial sphere `depth` deep in a slope of 50 deg, lateral one 0.15 mm above a
    flat.
    """
    slope = trimesh.creation.box(extents=(0.05, 0.004, 0.016))
    turn = trimesh.transformations.rotation_matrix(np.deg2rad(50.0), [1.0, 0.0, 0.0])
    centre = np.array([0.0, 0.01 + RADIUS + HEIGHT, -HALF])
    slope.apply_transform(turn)
    slope.apply_translation(centre - turn[:3, 1] * (RADIUS - depth + 0.002))
    flat = insert()
    mesh = trimesh.util.concatenate([trimesh.Trimesh(flat.vertices, flat.faces), slope])
    combined = Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), "insert")
    return ClosestPointQuery(condyles(), combined, 0.0)


@pytest.mark.parametrize(("depth", "turned"), [(1e-4, True), (2e-4, False)])
def test_a_turn_above_the_limit_is_not_made(depth: float, turned: bool) -> None:
    """A measured angle of 0.33 deg needs a turn of 0.6 deg, because one condyle is on a slope."""
    adjustment = adjust(on_a_flank(depth), tilted(0.0, HEIGHT))
    assert 0.2 < np.rad2deg(adjustment.measured_angle) < 0.4
    assert (adjustment.coronal_angle != 0.0) is turned
    assert abs(adjustment.coronal_angle) < np.deg2rad(0.5)


def test_level_condyles_are_not_turned(query: ClosestPointQuery) -> None:
    assert adjust(query, tilted(0.0)).coronal_angle == 0.0
    assert adjust(query, tilted(0.003)).coronal_angle == 0.0


def test_the_femur_is_moved_to_first_touch(query: ClosestPointQuery) -> None:
    for height in (-4e-4, 0.0, 4e-4):
        adjustment = adjust(query, tilted(0.0, height))
        assert adjustment.translation == pytest.approx(-height, abs=2e-6)
        assert not adjustment.flags


@pytest.mark.parametrize("height", [-1.76e-3, 0.6e-3, 1.76e-3])
def test_the_move_is_at_most_half_a_millimetre(query: ClosestPointQuery, height: float) -> None:
    adjustment = adjust(query, tilted(0.3, height))
    assert adjustment.translation == pytest.approx(-np.sign(height) * 5e-4, abs=1e-12)
    assert adjustment.pose[1, 3] == pytest.approx(
        adjustment.recorded[1, 3] + adjustment.translation, abs=1e-6
    )
    assert f"{abs(height) * 1e3:.2f} mm" in adjustment.flags[0]
    assert "first touch" in adjustment.flags[0]


def test_angles_near_the_lift_off_limit_are_flagged(query: ClosestPointQuery) -> None:
    """0.1 mm at a condyle is 0.13 deg: angles within 0.13 deg of 0.5 deg are flagged."""
    for angle, turned, flagged in ((0.3, True, False), (0.45, True, True), (0.55, False, True),
                                 (0.7, False, False)):  # fmt: skip
        adjustment = adjust(query, tilted(angle))
        assert (adjustment.coronal_angle != 0.0) is turned
        assert any("limit" in flag for flag in adjustment.flags) is flagged


def test_a_femur_far_from_the_insert_is_an_input_error(query: ClosestPointQuery) -> None:
    with pytest.raises(InputError, match="neither condyle"):
        adjust(query, tilted(0.0, 8e-3))


@cache
def prepared(query: ClosestPointQuery) -> tuple[ContactModel, Any]:
    model = contact_model("foundation", resolution=1e-3)
    return model, model.prepare(ContactPair(query.femoral, query.insert, material("polyethylene")))


def pressed(
    query: ClosestPointQuery,
    angle_deg: float,
    height: float,
    load: float,
    restore_when: RestoreRule = "both",
) -> tuple[ContactResult, Adjustment]:
    model, state = prepared(query)
    settings = AdjustmentSettings(restore_when=restore_when)
    adjustment = adjust(query, tilted(angle_deg, height), settings)
    return press_adjusted(model, state, load, adjustment, query)[:2]


def medial_share(result: ContactResult) -> float:
    medial, lateral = (0.0 if c is None else c.force for c in (result.medial, result.lateral))
    return medial / (medial + lateral)


def test_the_adjustment_stays_if_it_exceeds_the_deformation(query: ClosestPointQuery) -> None:
    result, adjustment = pressed(query, 0.3, 4e-4, 500.0, "either")
    assert adjustment.penetration < abs(adjustment.translation)
    assert not adjustment.restored
    assert not result.flags
    assert result.medial.force == pytest.approx(result.lateral.force, rel=1e-3)


def test_deeper_press_restores_the_recorded_rotation(query: ClosestPointQuery) -> None:
    """The femur is not moved along y, so every penetration exceeds the adjustment."""
    result, adjustment = pressed(query, 0.3, 0.0, 2500.0, "either")
    assert adjustment.restored
    assert not result.flags
    assert adjustment.penetration > 1e-5
    assert result.pose[:3, :3] == pytest.approx(tilted(0.3)[:3, :3])
    forces = [side.force for side in (result.medial, result.lateral) if side is not None]
    assert max(forces) > 0.6 * sum(forces)


def test_by_default_both_conditions_are_needed(query: ClosestPointQuery) -> None:
    """The penetration exceeds the move but is equal at both condyles, so the turn stays."""
    result, adjustment = pressed(query, 0.3, 0.0, 2500.0)
    assert not adjustment.restored
    assert adjustment.penetration > abs(adjustment.translation)
    assert abs(adjustment.final_angle) < abs(adjustment.coronal_angle)
    assert medial_share(result) == pytest.approx(0.5, abs=0.01)


SWEEP = np.arange(-0.7, 0.75, 0.1) * 1e-3


@pytest.mark.parametrize("angle_deg", [0.2, -0.3])
def test_the_split_does_not_depend_on_the_recorded_height(
    query: ClosestPointQuery, angle_deg: float
) -> None:
    shares = [medial_share(pressed(query, angle_deg, h, 1500.0)[0]) for h in SWEEP]
    assert shares == pytest.approx([0.5] * len(shares), abs=0.01)


def test_steps_of_the_split_with_either_condition_are_flagged(query: ClosestPointQuery) -> None:
    results = [pressed(query, 0.3, h, 1500.0, "either")[0] for h in SWEEP]
    shares = np.array([medial_share(result) for result in results])
    steps = np.flatnonzero(np.abs(np.diff(shares)) > 0.02)
    assert len(steps) == 2
    for step in steps:
        for side in (results[step], results[step + 1]):
            assert any("decides" in flag for flag in side.flags)


def test_the_step_of_the_split_at_the_lift_off_limit_is_flagged(query: ClosestPointQuery) -> None:
    """The split has a step at 0.5 deg, and frames on both sides are flagged."""
    angles = np.arange(-0.7, 0.75, 0.05)
    results = [pressed(query, a, 1e-4, 1500.0)[0] for a in angles]
    shares = np.array([medial_share(result) for result in results])
    steps = np.flatnonzero(np.abs(np.diff(shares)) > 0.1)
    assert np.abs(angles[steps] + 0.025) == pytest.approx([0.525, 0.525], abs=0.01)
    for step in steps:
        for side in (results[step], results[step + 1]):
            assert any("limit" in flag for flag in side.flags)


def test_the_adjustment_changes_the_split_and_not_the_total_force(query: ClosestPointQuery) -> None:
    adjusted, _ = pressed(query, 0.3, 0.0, 1500.0)
    recorded, _ = pressed(query, 0.3, 0.0, 1500.0, "either")
    for result in (adjusted, recorded):
        assert -result.wrench_on_insert[1] == pytest.approx(1500.0, rel=1e-3)
    assert adjusted.medial.force != pytest.approx(recorded.medial.force, rel=0.05)
