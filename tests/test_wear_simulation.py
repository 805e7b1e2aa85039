"""Wear over many cycles with closed forms, early ends, and the balance of the worn volume."""

import numpy as np
import pytest
import trimesh
from scipy.optimize import brentq

import shapes
from contact_bodies import dished_insert
from tkamb.errors import InputError
from tkamb.geometry.surface import Surface
from tkamb.studies.wear.laws import (
    Archard,
    ContactArea,
    CrossShear,
    LogarithmicCreep,
    PressureCrossShear,
)
from tkamb.studies.wear.simulation import simulate_wear
from wear_bodies import DENSITY, MM, ball_case, plate_case, stroke, swing, swinging_case

K = 1e-6
PLATE = 40 * 60  # mm²


def last(case, cycles, updates, **options):
    state, _ = simulate_wear(case, cycles, updates, **options)
    return state, state.rows[-1]


def test_a_plate_under_uniform_pressure_loses_k_p_s():
    motion = stroke(12 * MM, 5, 1000.0)
    state, row = last(plate_case(motion, Archard(K)), 1_000_000, 4)
    depth = K * (1000.0 / PLATE) * 24e-3 * 1e6  # mm, from k in mm³/(N m), p in N/mm², s in m
    assert state.wear == pytest.approx(depth * MM, rel=1e-9)
    assert row["volume_mm3"] == pytest.approx(depth * PLATE, rel=1e-9)
    assert row["mass_mg"] == pytest.approx(depth * PLATE * DENSITY * 1e-3, rel=1e-9)
    assert (row["mean_depth_mm"], row["worn_area_mm2"]) == pytest.approx((depth, PLATE), rel=1e-9)
    assert row["mesh_volume_lost_mm3"] == pytest.approx(row["volume_mm3"], rel=1e-9)


def test_wear_under_constant_pressure_is_linear_in_time():
    case = plate_case(stroke(12 * MM, 5, 1000.0), Archard(K))
    rows = simulate_wear(case, 1_000_000, 8)[0].rows
    cycles, volume = (np.array([row[key] for row in rows]) for key in ("cycles", "volume_mm3"))
    assert len(rows) == 9
    assert volume == pytest.approx(volume[-1] * cycles / cycles[-1], rel=1e-9)


def test_a_rectangular_path_wears_by_its_cross_shear():
    """A rectangle of 3 and 7 mm has CS = 0.3, and k(CS) has a closed form."""
    corners = np.array([[0, 0, 0], [7, 0, 0], [7, 0, 3], [0, 0, 3], [0, 0, 0]]) * MM
    motion = stroke(0.0, 5, 1000.0, passes=1)
    motion.poses[:, :3, 3] = corners
    volumes = {
        name: last(plate_case(motion, law), 1_000_000, 1)[1]["volume_mm3"]
        for name, law in (("archard", Archard(K)), ("cross", CrossShear(K, 6.0)))
    }
    assert volumes["archard"] == pytest.approx(K * 1000.0 * 20e-3 * 1e6, rel=1e-9)
    assert volumes["cross"] / volumes["archard"] == pytest.approx(2 * (1 + 5 * 0.3) / 7, rel=1e-9)


def test_wear_by_contact_area_does_not_depend_on_load():
    law = ContactArea((0.0, 0.5), (2e-9, 4e-9))
    volumes = [
        last(plate_case(stroke(12 * MM, 5, load), law), 1_000_000, 1)[1]["volume_mm3"]
        for load in (500.0, 2000.0)
    ]
    assert volumes == pytest.approx([2e-9 * PLATE * 24.0 * 1e6] * 2, rel=1e-9)


def test_a_table_of_wear_factors_is_interpolated_and_constant_outside():
    law = PressureCrossShear((0.0, 0.5), (1.0, 2.0), ((4e-7, 2e-7), (8e-7, 4e-7)))
    for load, factor in ((0.5 * PLATE, 4e-7), (1.5 * PLATE, 3e-7), (9.0 * PLATE, 2e-7)):
        row = last(plate_case(stroke(12 * MM, 5, load), law), 1_000_000, 1)[1]
        assert row["volume_mm3"] == pytest.approx(factor * load * 24e-3 * 1e6, rel=1e-9)


def test_a_moving_pin_distributes_its_wear_over_its_track():
    """The depth at a point is k p times the path in contact, here 2·8 mm of 2·24 mm."""
    motion = stroke(24 * MM, 97, 100.0)
    case = plate_case(motion, Archard(K), under=lambda x: np.abs(x[:, 0]) <= 4.01 * MM)
    state, row = last(case, 1_000_000, 1)
    points = case.articular.surface.vertices[case.articular.vertices]
    deep = state.wear[(np.abs(points[:, 0]) < 6 * MM)]
    assert row["volume_mm3"] == pytest.approx(K * 100.0 * 48e-3 * 1e6, rel=1e-9)
    assert deep.mean() / MM == pytest.approx(K * 100 / (8 * 60) * 16e-3 * 1e6, rel=0.05)


def test_a_cylinder_swinging_on_a_plate_wears_k_F_R_angle():
    """Sliding is the radius times the angle, and the volume is k times the work."""
    drum = trimesh.creation.cylinder(20 * MM, 30 * MM, sections=720)
    drum = Surface(np.asarray(drum.vertices), np.asarray(drum.faces, np.int64), "cylinder")
    case = swinging_case(drum, shapes.plate(0.012), swing(0.5, 5, 500.0))
    row = last(case, 1000, 1)[1]
    assert row["volume_mm3"] == pytest.approx(K * 500.0 * 20e-3 * 1.0 * 1e3, rel=0.01)
    assert row["mesh_volume_lost_mm3"] == pytest.approx(row["volume_mm3"], rel=1e-6)


def test_the_mesh_loses_the_volume_of_the_map_over_several_updates():
    dish = dished_insert(lambda x, z: 36 * MM - np.sqrt((30 * MM) ** 2 - x**2 - z**2), spacing=MM)
    case = swinging_case(shapes.sphere(25 * MM, 4), dish, swing(0.5, 5, 500.0))
    rows = simulate_wear(case, 30_000, 3)[0].rows
    assert len(rows) >= 4
    for row in rows[1:]:
        assert row["mesh_volume_lost_mm3"] == pytest.approx(row["volume_mm3"], rel=1e-6)
        assert row["volume_mm3"] == pytest.approx(K * 500.0 * 25e-3 * 1.0 * row["cycles"], rel=0.01)


def test_a_ball_swinging_in_a_trough_wears_k_F_R_angle():
    """Sliding at the contact is R times the angle, so the work is F R angle for any shape."""
    case = ball_case(shapes.trough(0.03), 20 * MM, swing(0.5, 5, 500.0), K, 2.0, facets=5)
    row = last(case, 100_000, 1)[1]
    # off the ball's lowest point, sliding is about half a per cent smaller
    assert row["volume_mm3"] == pytest.approx(K * 500.0 * 20e-3 * 1.0 * 1e5, rel=0.01)
    assert row["mesh_volume_lost_mm3"] == pytest.approx(row["volume_mm3"], rel=1e-9)


@pytest.mark.slow
def test_a_ball_wears_a_plate_to_its_own_shape():
    """The worn volume is that of a spherical cap with the worn depth."""
    radius = 20.0
    plate = shapes.plate(0.012, spacing=1 * MM)
    case = ball_case(plate, radius * MM, swing(1.0, 3, 200.0), 2e-6, facets=5)
    state, row = last(case, 1_000_000, 5)
    cap = brentq(lambda d: np.pi * d * d * (radius - d / 3) - row["volume_mm3"], 1e-6, radius)
    assert state.unsettled == 0
    assert row["max_depth_mm"] == pytest.approx(cap, rel=0.03)
    points = case.articular.surface.vertices[case.articular.vertices] / MM
    distance = np.hypot(points[:, 0], points[:, 2])
    inside = distance < 0.6 * np.sqrt(2 * radius * cap)
    # Height of the sphere's centre above the worn surface.
    height = radius - cap + state.wear[inside] / MM
    assert np.hypot(height, distance[inside]) == pytest.approx(radius, abs=0.03)


def test_the_error_is_of_first_order_in_the_block_length():
    """With most_change = 1 no block is repeated."""
    case = ball_case(shapes.plate(0.012, spacing=2 * MM), 20 * MM, swing(1.0, 2, 500.0), K, 2.0)
    depth = [last(case, 200_000, n, most_change=1.0)[1]["max_depth_mm"] for n in (2, 4, 8)]
    assert 1.5 < (depth[0] - depth[1]) / (depth[1] - depth[2]) < 3.0


def test_too_long_blocks_are_halved():
    case = ball_case(shapes.plate(0.012, spacing=2 * MM), 20 * MM, swing(1.0, 2, 500.0), K, 2.0)
    single_block = last(case, 1_000_000, 1, most_change=1.0)[1]["max_depth_mm"]
    state, row = last(case, 1_000_000, 1)
    assert len(state.rows) > 4
    assert row["cycles"] == 1_000_000  # the last block ends at the requested number
    assert row["max_depth_mm"] < 0.8 * single_block


def test_a_simulation_ends_when_the_plate_is_worn_through():
    case = plate_case(stroke(12 * MM, 3, 1000.0), Archard(1e-4), thickness=2 * MM)
    state, row = last(case, 10_000_000, 2)
    depth_per_cycle = 1e-4 * 1000.0 / PLATE * 24e-3  # mm
    assert state.end.startswith("worn through after")
    assert row["cycles"] == pytest.approx(1.9 / depth_per_cycle, rel=1e-9)
    assert row["max_depth_mm"] == pytest.approx(1.9, rel=1e-9)


def test_a_lost_contact_ends_the_simulation_with_its_results():
    case = plate_case(stroke(12 * MM, 3, 1000.0), Archard(1e-5), fails_below=9.5 * MM)
    state, row = last(case, 10_000_000, 10)
    assert "no contact is left" in state.end
    assert 0.3 < row["max_depth_mm"] <= 0.5


def test_a_block_that_loses_contact_is_halved():
    """One block removes 1 mm from a plate that loses contact after 0.5 mm."""
    law = Archard(1e-6 / (1000.0 * 24e-3) * PLATE)  # 1 mm in 10^6 cycles
    case = plate_case(stroke(12 * MM, 3, 1000.0), law, fails_below=9.5 * MM)
    state, row = last(case, 1_000_000, 1)
    assert "no contact is left" in state.end
    assert 0.49 < row["max_depth_mm"] <= 0.5


def test_a_contact_lost_in_the_shortest_first_block_is_an_input_error():
    case = plate_case(stroke(12 * MM, 3, 1000.0), Archard(1e-3), fails_below=9.999 * MM)
    with pytest.raises(InputError, match=r"after 391 cycles: .*no contact is left"):
        simulate_wear(case, 1_000_000, 10)


def test_no_contact_at_the_beginning_is_an_input_error():
    case = plate_case(stroke(12 * MM, 3, 1000.0), Archard(K), fails_below=1.0)
    with pytest.raises(InputError, match="no contact is left"):
        simulate_wear(case, 10, 1)


@pytest.mark.parametrize(("cycles", "updates"), [(0, 1), (-5, 1), (10, 0), (10, 11), (10**10, 1)])
def test_numbers_of_cycles_out_of_range_are_refused(cycles, updates):
    case = plate_case(stroke(12 * MM, 3, 1000.0), Archard(K))
    with pytest.raises(InputError, match=r"--cycles|--updates"):
        simulate_wear(case, cycles, updates)


def test_creep_follows_the_logarithm_of_time_and_is_not_wear():
    law = LogarithmicCreep(3e-3, 8e-4, 1000.0)
    case = plate_case(stroke(12 * MM, 3, 2.0 * PLATE), Archard(0.0), creep=law)
    rows = simulate_wear(case, 6_000_000, 3, most_change=1.0)[0].rows
    for row in rows[1:]:
        minutes = row["cycles"] / 60.0
        strain = 2.0 * (3e-3 + 8e-4 * np.log10(minutes / 1000.0))
        # creep reduces the thickness, an effect of second order in the strain
        assert row["creep_depth_mm"] == pytest.approx(10 * strain, rel=5e-3)
        assert row["creep_volume_mm3"] == pytest.approx(PLATE * row["creep_depth_mm"], rel=1e-9)
        assert row["volume_mm3"] == row["max_depth_mm"] == 0.0
        assert row["mesh_volume_lost_mm3"] == pytest.approx(row["creep_volume_mm3"], rel=1e-9)


def test_the_mesh_loses_the_volumes_of_wear_and_creep():
    law = LogarithmicCreep(3e-3, 8e-4, 1000.0)
    case = plate_case(stroke(12 * MM, 3, 2.0 * PLATE), Archard(K), creep=law)
    row = last(case, 1_000_000, 3)[1]
    assert row["mesh_volume_lost_mm3"] == pytest.approx(
        row["volume_mm3"] + row["creep_volume_mm3"], rel=1e-9
    )


def test_creep_is_zero_before_its_law_begins():
    law = LogarithmicCreep(1e-3, 1e-3, 100.0)
    assert law.strain_per_pascal(0.0) == 0.0
    assert law.strain_per_pascal(60.0 * 10.0) == pytest.approx(0.0, abs=1e-18)
    assert law.strain_per_pascal(60.0 * 1000.0) == pytest.approx(2e-9)
