"""Femoral adjustment: what is corrected, what is left, and what is undone after the press."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactResult
from tkamb.equilibrium.adjusted_press import press_adjusted
from tkamb.errors import InputError
from tkamb.geometry.adjustment import adjust
from tkamb.geometry.closest import ClosestPointQuery
from tkamb.geometry.frames import Array, pose, transform
from tkamb.geometry.surface import Surface

RADIUS, HALF = 0.02, 0.022
HEIGHT = 1.5e-4


def insert() -> Surface:
    box = trimesh.creation.box(extents=(0.05, 0.01, 0.08))
    mesh = box.apply_translation([0.0, 0.005, 0.0])
    for _ in range(3):
        mesh = mesh.subdivide()
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), "insert")


def condyles() -> Surface:
    """Two balls of 20 mm radius, 44 mm apart."""
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
    """Femur turned about x by an angle, its middle `height` above touching a flat insert."""
    rotation = Rotation.from_euler("x", angle_deg, degrees=True).as_matrix()
    return pose(rotation, [0.0, 0.01 + height, 0.0])


@pytest.mark.parametrize("angle_deg", [0.4, -0.4, 0.1])
def test_small_coronal_error_is_corrected(query: ClosestPointQuery, angle_deg: float) -> None:
    found = adjust(query, tilted(angle_deg))
    assert np.rad2deg(found.coronal_angle) == pytest.approx(-angle_deg, abs=0.01)
    assert np.rad2deg(found.measured_angle) == pytest.approx(-angle_deg, abs=0.02)
    medial, lateral = (gap.gap for gap in vars(query.at(found.pose)).values())
    assert medial == pytest.approx(0.0, abs=2e-6)
    assert lateral == pytest.approx(0.0, abs=2e-6)


@pytest.mark.parametrize("angle_deg", [0.6, -0.6])
def test_large_coronal_error_is_lift_off_and_left(
    query: ClosestPointQuery, angle_deg: float
) -> None:
    found = adjust(query, tilted(angle_deg))
    assert found.coronal_angle == 0.0
    assert found.pose[:3, :3] == pytest.approx(tilted(angle_deg)[:3, :3])
    gaps = sorted(gap.gap for gap in vars(query.at(found.pose)).values())
    assert gaps[0] == pytest.approx(0.0, abs=2e-6)
    assert gaps[1] == pytest.approx(2 * HALF * np.deg2rad(0.6), rel=0.02)


@pytest.mark.parametrize("angle_deg", [0.4, -0.3])
def test_the_components_centre_stays_where_it_was_recorded(
    query: ClosestPointQuery, angle_deg: float
) -> None:
    recorded = tilted(angle_deg)
    found = adjust(query, recorded)
    centre = query.femoral.bounds.mean(axis=0)
    before, after = (transform(one, centre) for one in (recorded, found.pose))
    np.testing.assert_allclose(after, before + np.array([0.0, found.translation, 0.0]), atol=1e-12)


def on_a_flank(depth: float) -> ClosestPointQuery:
    """The medial ball `depth` deep in a slope of 50 deg, the lateral one 0.15 mm over a flat."""
    slope = trimesh.creation.box(extents=(0.05, 0.004, 0.016))
    turn = trimesh.transformations.rotation_matrix(np.deg2rad(50.0), [1.0, 0.0, 0.0])
    centre = np.array([0.0, 0.01 + RADIUS + HEIGHT, -HALF])
    slope.apply_transform(turn)
    slope.apply_translation(centre - turn[:3, 1] * (RADIUS - depth + 0.002))
    flat = insert()
    mesh = trimesh.util.concatenate([trimesh.Trimesh(flat.vertices, flat.faces), slope])
    whole = Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), "insert")
    return ClosestPointQuery(condyles(), whole, 0.0)


@pytest.mark.parametrize(("depth", "made"), [(1e-4, True), (2e-4, False)])
def test_a_turn_beyond_the_error_is_not_made(depth: float, made: bool) -> None:
    """On a flank a small gap is a long way down: 0.33 deg measured would take 0.6 deg."""
    found = adjust(on_a_flank(depth), tilted(0.0, HEIGHT))
    assert 0.2 < np.rad2deg(found.measured_angle) < 0.4
    assert (found.coronal_angle != 0.0) is made
    assert abs(found.coronal_angle) < np.deg2rad(0.5)


def test_level_condyles_are_not_turned(query: ClosestPointQuery) -> None:
    assert adjust(query, tilted(0.0)).coronal_angle == 0.0
    assert adjust(query, tilted(0.003)).coronal_angle == 0.0


def test_always_moved_to_first_touch(query: ClosestPointQuery) -> None:
    for height in (-1e-3, 0.0, 1e-3):
        found = adjust(query, tilted(0.0, height))
        assert found.translation == pytest.approx(-height, abs=2e-6)


def test_neither_condyle_near_is_an_input_error(query: ClosestPointQuery) -> None:
    with pytest.raises(InputError, match="neither condyle"):
        adjust(query, tilted(0.0, 8e-3))


def pressed(
    query: ClosestPointQuery, angle_deg: float, height: float, load: float, **options: str
) -> tuple[ContactResult, object]:
    model = contact_model("foundation", 1.0)
    pair = ContactPair(query.femoral, query.insert, material("polyethylene"))
    state = model.prepare(pair)
    adjustment = adjust(query, tilted(angle_deg, height))
    return press_adjusted(model, state, load, adjustment, query, **options)


def test_adjustment_holds_when_it_exceeds_the_deformation(query: ClosestPointQuery) -> None:
    result, found = pressed(query, 0.3, 1e-3, 500.0)
    assert found.penetration < abs(found.translation)
    assert not found.restored
    assert result.medial.force == pytest.approx(result.lateral.force, rel=1e-3)


def test_deeper_press_restores_the_recorded_rotation(query: ClosestPointQuery) -> None:
    """First touch is all the femur was moved by: any load sinks it deeper than that."""
    result, found = pressed(query, 0.3, 0.0, 2500.0)
    assert found.restored
    assert found.penetration > 1e-5
    assert result.pose[:3, :3] == pytest.approx(tilted(0.3)[:3, :3])
    forces = [side.force for side in (result.medial, result.lateral) if side is not None]
    assert max(forces) > 0.6 * sum(forces)


def test_both_conditions_are_the_sources_reading(query: ClosestPointQuery) -> None:
    _, found = pressed(query, 0.3, 0.0, 2500.0, restore_when="both")
    assert not found.restored
    assert abs(found.final_angle) < abs(found.coronal_angle)


def test_total_force_is_unchanged_and_split_moves(query: ClosestPointQuery) -> None:
    """The load is the load; the adjustment decides how the condyles share it."""
    adjusted, _ = pressed(query, 0.3, 1e-3, 1500.0)
    left, _ = pressed(query, 0.3, 0.0, 1500.0)
    for result in (adjusted, left):
        assert -result.wrench_on_insert[1] == pytest.approx(1500.0, rel=1e-3)
    assert adjusted.medial.force != pytest.approx(left.medial.force, rel=0.05)
