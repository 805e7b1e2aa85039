"""Elastic foundation, its columns and the press, against closed forms."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.special import jv

from contact_bodies import dished_insert, flat_insert, graded_sphere, joined
from patella_bodies import read_plane
from tkamb.contact import samples as contact_samples
from tkamb.contact.foundation import (
    OVER_THE_EDGE,
    TOO_DEEP,
    ElasticFoundation,
    FoundationProbe,
    LinearFoundation,
    layer_pressure,
    layer_slope,
)
from tkamb.contact.materials import LinearElastic, Material, material, tabulated_material
from tkamb.contact.pair import ContactPair
from tkamb.contact.pressing import PRESS, press_by_search, search_load
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus
from tkamb.contact.samples import meet, sample_surface
from tkamb.errors import InputError
from tkamb.geometry.frames import inverse, knee_pose, knee_twist, pose
from tkamb.geometry.surface import Surface
from tkamb.knee.contact import CONTACT_DIFFERENCE, differences

LINEAR = material("polyethylene-linear")
POLYETHYLENE = material("polyethylene")
M = LINEAR.confined_modulus
RADIUS, HEIGHT = 30e-3, 10e-3


@cache
def sphere_on_block(chosen=LINEAR):
    return ContactPair(graded_sphere(RADIUS), flat_insert(HEIGHT), chosen)


def lowered(depth, x=0.0, z=0.0):
    return pose(np.eye(3), [x, HEIGHT + RADIUS - depth, z])


def reaction(model, state, at):
    return -model.evaluate(state, at).wrench_on_insert[1]


def cap(depth):
    """Return the volume of a spherical cap."""
    return np.pi * depth**2 * (RADIUS - depth / 3)


def test_the_force_of_a_sphere_is_proportional_to_the_volume_of_its_cap():
    """Force = M/h times the cap's volume. Twice the depth gives 3.9 to 4.0 times the force."""
    model = LinearFoundation(0.5e-3)
    state = model.prepare(sphere_on_block())
    depths = np.array([0.1e-3, 0.2e-3, 0.4e-3, 0.8e-3])
    forces = np.array([reaction(model, state, lowered(d)) for d in depths])
    assert np.allclose(forces, M / HEIGHT * cap(depths), rtol=8e-3)
    ratio = forces[1:] / forces[:-1]
    assert (ratio[1:] > 3.9).all()
    assert (ratio[1:] < 4.0).all()


def test_the_force_converges_with_second_order():
    """Root mean square error over positions of the grid under the sphere, 2 to 0.5 mm."""
    errors = []
    shifts = np.linspace(0, 1, 7)[:-1]
    for resolution in (2e-3, 1e-3, 0.5e-3):
        model = LinearFoundation(resolution)
        state = model.prepare(sphere_on_block())
        forces = [
            reaction(model, state, lowered(0.2e-3, a * resolution, b * resolution))
            for a in shifts
            for b in shifts[::2]
        ]
        errors.append(np.sqrt(np.mean((np.array(forces) / (M / HEIGHT * cap(0.2e-3)) - 1) ** 2)))
    slope = np.polyfit(np.log([4, 2, 1]), np.log(errors), 1)[0]
    assert slope > 1.5, errors
    assert errors[1] < 0.03


def test_a_flat_punch_gives_uniform_pressure_on_the_whole_top():
    """Tributary areas add up to the area of the top, also if the cells do not fit."""
    insert = flat_insert(8e-3, half_x=10.3e-3, half_z=13.7e-3)
    punch = flat_insert(5e-3, half_x=20e-3, half_z=20e-3)
    model = LinearFoundation(1e-3)
    state = model.prepare(ContactPair(punch, insert, LINEAR))
    result = model.evaluate(state, pose(np.eye(3), [0, 8e-3 - 0.1e-3, 0]))
    assert np.allclose(result.pressure, M * 0.1 / 8, rtol=1e-9)
    assert result.medial.area == pytest.approx(4 * 10.3e-3 * 13.7e-3, rel=5e-3)
    assert result.medial.thickness == pytest.approx(8e-3)
    assert result.approach == pytest.approx(0.1e-3, abs=1e-12)
    assert np.allclose(result.medial.centre_of_pressure, [0, 8e-3, 0], atol=1e-9)


def test_map_points_lie_on_the_mesh_with_exact_areas_normals_and_thickness():
    radius = 25e-3
    insert = dished_insert(lambda x, z: 32e-3 - np.sqrt(radius**2 - x**2 - z**2))
    bed = sample_surface(insert, 1e-3)
    outward = np.array([0, 32e-3, 0]) - bed.points
    distance = np.linalg.norm(outward, axis=1)
    assert np.allclose(distance, radius, atol=8e-6)
    outward /= distance[:, None]
    assert np.einsum("ij,ij->i", bed.normals, outward).min() > np.cos(np.radians(1.0))
    assert np.allclose(bed.thickness, bed.points[:, 1])
    along = bed.points[:, 1] / bed.normals[:, 1]
    foot = bed.points - along[:, None] * bed.normals
    onto_bottom = (np.abs(foot[:, [0, 2]]) < 15e-3).all(axis=1)
    assert onto_bottom.any()
    assert np.allclose(bed.depth[onto_bottom], along[onto_bottom], atol=1e-9)
    x, z = (g.ravel() for g in np.meshgrid(*2 * [np.linspace(-15e-3, 15e-3, 601)]))
    true = (30e-3) ** 2 * np.mean(radius / np.sqrt(radius**2 - x**2 - z**2))
    assert bed.area.sum() == pytest.approx(true, rel=3e-3)
    corners = bed.points[bed.triangles]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (facing[:, 1] > 0).all()


def test_map_points_include_a_post():
    insert = dished_insert(lambda x, z: np.where(np.hypot(x, z) < 4e-3, 20e-3, 8e-3))
    bed = sample_surface(insert, 1e-3)
    on_post = np.hypot(bed.points[:, 0], bed.points[:, 2]) < 3.4e-3
    assert np.allclose(bed.points[on_post, 1], 20e-3)
    assert np.allclose(bed.thickness[on_post], 20e-3)


def test_an_open_insert_is_refused():
    closed = flat_insert(8e-3)
    up = closed.face_normals[:, 1] > 0.5
    with pytest.raises(InputError, match="closed"):
        sample_surface(Surface(closed.vertices, closed.faces[up], "lid"), 1e-3)


def test_pressure_laws_have_their_closed_forms():
    strain = np.array([0.0, 1e-6, 0.01, 0.1, 0.4])
    assert np.allclose(layer_pressure("linear", LINEAR, strain), M * strain)
    assert np.allclose(layer_pressure("nonlinear", LINEAR, strain), -M * np.log1p(-strain))
    polyethylene = material("polyethylene")
    pressure = layer_pressure("nonlinear", polyethylene, strain)
    assert pressure[1] == pytest.approx(M * 1e-6, rel=1e-5)
    assert (np.diff(pressure) > 0).all()
    assert (pressure[2:] < M * strain[2:]).all()
    true_strain = -np.log1p(-strain[2:])
    secant = polyethylene.secant(true_strain * M / 561.5e6)
    assert np.allclose(pressure[2:], M / 561.5e6 * secant * true_strain)


def test_the_force_does_not_depend_on_the_femoral_frame():
    """The mesh is given in a frame turned by 130 deg of flexion, and the pose is turned back."""
    pair = sphere_on_block()
    turned = knee_pose([2e-3, 1e-3, 0, 0, 0, np.radians(130)])
    other = ContactPair(pair.femoral.moved(turned), pair.insert, pair.material)
    model = LinearFoundation(1e-3)
    expected = model.press(model.prepare(pair), 800.0, lowered(0))
    result = model.press(model.prepare(other), 800.0, lowered(0) @ inverse(turned))
    assert result.approach == pytest.approx(expected.approach, rel=1e-9)
    assert np.allclose(result.pressure, expected.pressure, rtol=1e-6, atol=1.0)


@cache
def two_spheres(gap=24e-3):
    return joined(
        graded_sphere(20e-3, (0, 0, -gap / 2)),
        graded_sphere(20e-3, (0, 0, gap / 2)),
    )


def test_two_condyles_share_the_load_by_their_penetrations():
    model = LinearFoundation(1e-3)
    state = model.prepare(ContactPair(two_spheres(), flat_insert(HEIGHT, half_z=28e-3), LINEAR))
    level = model.press(state, 1500.0, np.eye(4))
    residual = abs(1.0 + level.wrench_on_insert[1] / 1500.0)
    assert 1e-12 < level.residual == pytest.approx(residual, rel=1e-3)
    assert level.medial.force == pytest.approx(750, rel=1e-6)
    assert level.lateral.force == pytest.approx(750, rel=1e-6)
    assert level.medial.centre_of_pressure == pytest.approx([0, HEIGHT, -12e-3], abs=1e-5)
    assert level.lateral.centre_of_pressure == pytest.approx([0, HEIGHT, 12e-3], abs=1e-5)
    varus = model.press(state, 1500.0, knee_pose([0, 0, 0, 0, np.radians(0.3), 0]))
    height_difference = 24e-3 * np.sin(np.radians(0.3))
    deeper = (varus.medial.peak_pressure - varus.lateral.peak_pressure) * HEIGHT / M
    assert varus.medial.force + varus.lateral.force == pytest.approx(1500, rel=1e-6)
    assert deeper == pytest.approx(height_difference, rel=0.01)


def test_varus_loads_the_medial_condyle():
    model = ElasticFoundation(1e-3)
    insert = flat_insert(HEIGHT, half_z=28e-3)
    state = model.prepare(ContactPair(two_spheres(), insert, material("polyethylene")))
    varus = model.press(state, 1000.0, knee_pose([0, 0, 0, 0, np.radians(0.3), 0]))
    assert varus.medial.force > 1.5 * varus.lateral.force


@pytest.mark.parametrize("load", [1e-6, 1.0, 300.0, 3000.0])
def test_loads_of_any_size_are_reached(load):
    model = ElasticFoundation(0.5e-3)
    state = model.prepare(sphere_on_block(material("polyethylene")))
    result = model.press(state, load, lowered(0, x=0.13e-3))
    assert result.status is ContactStatus.OK
    assert -result.wrench_on_insert[1] == pytest.approx(load, rel=1e-6)
    # The search begins at the sagitta of the facets; a millionth of a newton lies far from there.
    assert result.iterations < (50 if load >= 1 else 80)


@pytest.mark.parametrize("name", ["foundation", "foundation-linear", "hertz", "lattice-linear"])
@pytest.mark.parametrize("depth", [10.5e-3, 25e-3, 31e-3, 50e-3, 80e-3])
def test_a_femur_pushed_through_the_insert_is_out_of_range(name, depth):
    """The depths run from the bottom of the insert to a femur that lies wholly below it."""
    pair = ContactPair(graded_sphere(10e-3), flat_insert(HEIGHT), material("polyethylene"))
    model = contact_model(name, resolution=3e-3)
    state = model.prepare(pair)
    at = pose(np.eye(3), [0.1e-3, HEIGHT + 10e-3 - depth, 0.1e-3])
    result = model.evaluate(state, at)
    assert result.status is ContactStatus.OUT_OF_RANGE
    assert result.flags
    assert not model.probe(state).at(at).known
    above = pose(np.eye(3), [0.1e-3, HEIGHT + 11e-3, 0.1e-3])
    assert model.evaluate(state, above).status is ContactStatus.OK


def test_zero_load_is_first_touch():
    pair = sphere_on_block()
    model = LinearFoundation(1e-3)
    result = model.press(model.prepare(pair), 0.0, lowered(5e-3))
    assert result.approach == 0
    assert result.pose[1, 3] == pytest.approx(HEIGHT + RADIUS, abs=1e-9)
    assert result.medial is None
    assert not result.pressure.any()


@pytest.mark.parametrize("load", [-1.0, float("nan"), float("inf")])
def test_an_impossible_load_is_an_input_error(load):
    model = LinearFoundation(1e-3)
    with pytest.raises(InputError, match="load: cannot be"):
        model.press(model.prepare(sphere_on_block()), load, lowered(0))


def test_out_of_range_is_nan_with_a_reason():
    model = ElasticFoundation(1e-3)
    state = model.prepare(sphere_on_block(material("polyethylene")))
    deep = model.evaluate(state, lowered(6e-3))
    assert deep.failed is True and deep.status is ContactStatus.OUT_OF_RANGE
    assert deep.reason == f"{TOO_DEEP}: 6.00 mm deep, at most 5.00 mm"
    assert model.evaluate(state, lowered(1e-4)).failed is False
    assert np.isnan(deep.pressure).all()
    overloaded = model.press(state, 1e7, lowered(0))
    assert overloaded.status is ContactStatus.OUT_OF_RANGE
    assert "half the insert's thickness" in " ".join(overloaded.flags)
    beside = model.press(state, 100.0, lowered(0, x=60e-3))
    assert beside.status is ContactStatus.OUT_OF_RANGE
    assert "does not lie over the insert, but 15.0 mm beside it" in beside.reason
    assert beside.medial is None


def test_a_rim_column_that_starts_in_the_femur_under_the_dish_is_no_penetration():
    """Half-way through the insert, the normal of a steep chamfer lies under the flat top, in the
    sphere.
    """
    radius, depth = 6e-3, 3e-3
    outline = [(-15, 0), (15.5, 0), (15, 8), (14, 10), (-15, 10)]  # z, y in mm
    corners = [(x, y, z) for x in (-15, 15) for z, y in outline]
    hull = trimesh.convex.convex_hull(np.array(corners) * 1e-3).subdivide_to_size(1e-3)
    insert = Surface(np.asarray(hull.vertices), np.asarray(hull.faces), "insert")
    model, femoral = LinearFoundation(0.5e-3), graded_sphere(radius)
    state = model.prepare(ContactPair(femoral, insert, LINEAR))
    at = pose(np.eye(3), [0, HEIGHT + radius - depth, 8.5e-3])
    within = state.surface.points - 5e-3 * state.surface.normals
    steep = (state.surface.normals[:, 1] < 0.5) & (
        np.linalg.norm(within - at[:3, 3], axis=1) < radius
    )
    assert steep.any()
    volume = np.pi * depth**2 * (radius - depth / 3)
    assert reaction(model, state, at) == pytest.approx(M / HEIGHT * volume, rel=8e-3)


def test_the_femur_over_an_edge_has_its_own_message():
    """A slope of 45 deg ends in a crest that is 31 mm high and less than 1 mm thick along the
    normal.
    """
    outline = [(-15, 0), (15, 0), (15, 32), (-15, 2)]  # z, y in mm
    corners = [(x, y, z) for x in (-15, 15) for z, y in outline]
    hull = trimesh.convex.convex_hull(np.array(corners) * 1e-3)
    insert = Surface(np.asarray(hull.vertices), np.asarray(hull.faces), "insert")
    model = LinearFoundation(0.5e-3)
    state = model.prepare(ContactPair(graded_sphere(6e-3), insert, LINEAR))
    out = np.array([0, 1, -1]) / np.sqrt(2)

    def at(depth, z):
        return model.evaluate(state, pose(np.eye(3), [0, 17e-3 + z, z] + (6e-3 - depth) * out))

    assert at(0.5e-3, 10e-3).status is at(0.05e-3, 14.5e-3).status is ContactStatus.OK
    (flag,) = at(0.5e-3, 14.5e-3).flags
    assert flag.startswith(f"{OVER_THE_EDGE}: ") and flag.endswith("mm lies wholly inside it")


@pytest.mark.parametrize("share", [0.5, 0.999, 1.05, 3.0])
def test_near_columns_go_out_of_range_like_all_columns(share, monkeypatch):
    model = ElasticFoundation(1e-3)
    state = model.prepare(sphere_on_block(material("polyethylene")))
    largest_load = -model.evaluate(state, lowered(0.4999 * HEIGHT)).wrench_on_insert[1]
    evaluations, evaluate = [], ElasticFoundation.evaluate

    def counted(self, *arguments):
        evaluations.append(1)
        return evaluate(self, *arguments)

    monkeypatch.setattr(ElasticFoundation, "evaluate", counted)
    result = model.press(state, share * largest_load, lowered(0))
    near_count = len(evaluations)
    expected = press_by_search(model, state, share * largest_load, lowered(0))
    assert result.status is expected.status
    assert (result.status is ContactStatus.OK) == (share < 1.0)
    assert result.flags == expected.flags
    np.testing.assert_allclose(result.approach, expected.approach, rtol=1e-6)
    assert (
        near_count <= 2 < len(evaluations) - near_count
    )  # all columns are evaluated at the end, and once at the end of the range


@pytest.mark.parametrize("distance", [0.0, 1.0e-3, 3.0e-3, 12.0e-3])
def test_a_guess_saves_evaluations_and_does_not_change_the_result(distance, monkeypatch):
    """From a neighbouring pose the guess selects the columns; from a far pose all columns are
    evaluated.
    """
    model = ElasticFoundation(1e-3)
    state = model.prepare(sphere_on_block(material("polyethylene")))
    alone = model.press(state, 1500.0, lowered(0))
    before = model.press(state, 1500.0, lowered(0, x=-distance))
    evaluations, sums = [], FoundationProbe.sums

    def counted(self, *arguments):
        result = sums(self, *arguments)
        evaluations.append(len(self._last[1]))
        return result

    monkeypatch.setattr(FoundationProbe, "sums", counted)
    result = model.press(state, 1500.0, lowered(0), before)
    assert result.status is ContactStatus.OK
    assert result.residual <= PRESS.load_tolerance
    np.testing.assert_allclose(result.approach, alone.approach, rtol=1e-6)
    nearer_than = contact_samples.FARTHEST / contact_samples.OBLIQUE
    assert (evaluations[0] < len(state.points)) == (distance < nearer_than)


def test_a_failed_guess_or_one_with_other_map_points_is_not_used():
    model = ElasticFoundation(1e-3)
    bodies = sphere_on_block(material("polyethylene"))
    state, coarse = model.prepare(bodies), ElasticFoundation(2e-3).prepare(bodies)
    alone = model.press(state, 1500.0, lowered(0))
    failed = model.evaluate(state, lowered(0.9 * HEIGHT))
    assert failed.status is ContactStatus.OUT_OF_RANGE
    for guess in (failed, model.press(coarse, 1500.0, lowered(0))):
        result = model.press(state, 1500.0, lowered(0), guess)
        np.testing.assert_allclose(result.approach, alone.approach, rtol=1e-6)


@cache
def two_dishes(bulk=None):
    """Return a rounded, two-condyle component in two dishes: normals of both bodies differ."""
    insert = dished_insert(
        lambda x, z: 8e-3 + x**2 / (2 * 50e-3) + (np.abs(z) - 12e-3) ** 2 / (2 * 60e-3),
        half_z=24e-3,
        spacing=1e-3,
    )
    model = ElasticFoundation(2e-3)
    return model, model.prepare(ContactPair(two_spheres(), insert, bulk or POLYETHYLENE))


def loop_work(probe, centre, amplitude, phase, steps):
    """Return the work (J) of the contact on the femur over a closed loop of knee coordinates."""
    work = 0.0
    for turn in 2 * np.pi * np.arange(steps) / steps:
        place = centre + amplitude * (np.sin(turn + phase) - np.sin(phase))
        velocity, spin = knee_twist(place, amplitude * np.cos(turn + phase))
        wrench = probe.at(knee_pose(place)).wrench
        moment = wrench[3:] - np.cross(place[:3], wrench[:3])
        work -= (wrench[:3] @ velocity + moment @ spin) * 2 * np.pi / steps
    return work


def test_a_small_load_is_carried_where_the_triangles_do_not_touch_yet():
    """The smooth surface lies up to 60 µm below triangles of 8 degrees."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=20e-3)
    femoral = Surface(ball.vertices, ball.faces, "ball")
    pair = ContactPair(femoral, flat_insert(HEIGHT), LINEAR)
    model, loads = LinearFoundation(0.5e-3), (0.1, 10.0, 1000.0)
    assert 40e-6 < femoral.curved.sag < 80e-6
    state = model.prepare(pair)
    for angle in (0.0, 0.05, 0.1):
        for load in loads:
            result = model.press(state, load, knee_pose([0, 0, 0, 0, 0, angle]))
            assert result.status is ContactStatus.OK
            assert result.residual <= PRESS.load_tolerance


@pytest.mark.parametrize("turning", [False, True])
def test_the_work_over_a_closed_loop_vanishes(turning):
    """Forces along the insert's normal would leave 2 to 5 mJ."""
    model, state = two_dishes()
    pressed, probe = model.press(state, 1500.0, np.eye(4)), model.probe(state)
    amplitude = np.array([1.5e-3, 4e-5, 5e-4, 0.002, 0.02, 0.04]) * [1, 1, 1, *3 * [turning]]
    phase = np.array([0.0, 1.3, 2.1, 0.4, 2.9, 1.0])
    centre = np.array([0.0, pressed.pose[1, 3], 0.0, 0.0, 0.0, 0.0])
    assert abs(loop_work(probe, centre, amplitude, phase, 400)) < 1e-5


@pytest.mark.parametrize(("cell", "depth"), [(1e-3, 0.2e-3), (0.5e-3, 0.12e-3)])
def test_the_map_holds_a_ball_on_a_plate_with_the_closed_form(cell, depth):
    """The sum of the energy over cells of the size s exceeds its integral by waves of length s.

    By Poisson's formula the wave along x is 2 W(k) cos(k x), k = 2 pi/s, with the transform W of
    the energy M d²/2h, d = depth (1 - r²/a²): W(k) = 8 pi a² M depth² J3(k a)/(h (k a)³). The slope
    of the wave, by the load F = pi M a² depth/2h, is 32 k depth J3(k a)/(k a)³.
    """
    model = LinearFoundation(cell)
    probe = model.probe(model.prepare(sphere_on_block()))
    places, wave = cell * np.arange(8) / 8, 2 * np.pi / cell
    waves, loads = 0.0, 0.0
    for x in places:
        for z in places[::2]:
            ap, si = probe.at(lowered(depth, x, z)).wrench[:2]
            waves, loads = waves + 2 * ap * np.sin(wave * x), loads + si
    phase = wave * np.sqrt(2 * RADIUS * depth - depth**2)
    expected = 32 * wave * depth * jv(3, phase) / phase**3
    assert -waves / loads == pytest.approx(expected, rel=0.05)


CURVE = np.linspace(0.0, 0.3, 31)
TABLE = tabulated_material("table", CURVE, POLYETHYLENE.stress(CURVE), 0.45)


class HalfLaw(LinearElastic):
    """A user's law: half of Hooke's."""

    def stress(self, strain, young_modulus):
        return 0.5 * super().stress(strain, young_modulus)

    def tangent(self, strain, young_modulus):
        return 0.5 * super().tangent(strain, young_modulus)


HALF = Material("half", LINEAR.young_modulus, LINEAR.poisson_ratio, HalfLaw())
LAWS = [POLYETHYLENE, LINEAR, TABLE, HALF]


@pytest.mark.parametrize("law", ["linear", "nonlinear"])
@pytest.mark.parametrize("bulk", LAWS, ids=lambda bulk: bulk.name)
def test_the_compiled_sums_agree_with_numpy(law, bulk):
    """Wrench and centre of each condyle: columns push with p A along the femoral normal."""
    model, state = two_dishes(bulk)
    model = replace(model, law=law)
    at = model.press(state, 1500.0, knee_pose([1e-3, 0, 3e-4, 0.01, 0.0, 0.2])).pose
    bed, met = state.surface, meet(state.surface, state.pair.femoral, at)
    pressure = layer_pressure(law, bulk, np.maximum(-met.gap, 0.0) / bed.thickness)
    along = np.einsum("ij,ij->i", met.gradient, bed.normals)
    forces = (-pressure * bed.area / np.where(along, along, 1.0))[:, None] * met.gradient
    places, size = bed.points + met.gap[:, None] * bed.normals, np.linalg.norm(forces, axis=1)
    medial = (bed.points - at[:3, 3]) @ at[:3, 2] < state.pair.split
    found = model.probe(state).at(at).condyles
    assert set(found) == {"medial", "lateral"}
    for side, chosen in (("medial", medial), ("lateral", ~medial)):
        chosen = chosen & (pressure > 0.0)
        force = forces[chosen].sum(axis=0)
        moment = np.cross(places[chosen], forces[chosen]).sum(axis=0)
        wrench, centre = np.append(force, moment), size[chosen] @ bed.points[chosen]
        scale = 1e-12 * np.abs(wrench).max()
        np.testing.assert_allclose(found[side].wrench, wrench, rtol=1e-12, atol=scale)
        np.testing.assert_allclose(found[side].centre, centre / size[chosen].sum(), 1e-12, 1e-15)


@pytest.mark.parametrize("bulk", LAWS, ids=lambda bulk: bulk.name)
def test_the_stiffness_is_the_slope_of_the_wrench(bulk):
    model, state = two_dishes(bulk)
    pressed = model.press(state, 1500.0, knee_pose([1e-3, 0, 3e-4, 0.01, 0.0, 0.2]))
    probe = model.probe(state)
    stiffness = sum(load.stiffness for load in probe.at(pressed.pose).loads)
    slope = differences(
        lambda at: probe.at(at).wrench, pressed.pose, replace(CONTACT_DIFFERENCE, step=1e-9)
    )
    np.testing.assert_allclose(slope, stiffness, rtol=0, atol=1e-6 * np.abs(stiffness).max())


def test_columns_missed_by_the_neighbourhood_are_found_by_the_final_evaluation():
    """With the gaps of another pose the search misses columns."""
    model = ElasticFoundation(1e-3)
    state = model.prepare(sphere_on_block(material("polyethylene")))
    alone = model.press(state, 1500.0, lowered(0))
    before = model.press(state, 1500.0, lowered(0, x=-12e-3))
    missing = replace(before, pose=alone.pose)
    assert not model.probe(state).seen(missing).condyles
    result = model.press(state, 1500.0, lowered(0), missing)
    np.testing.assert_allclose(result.approach, alone.approach, rtol=1e-6)


def test_a_probe_at_a_far_pose_evaluates_other_columns():
    model = ElasticFoundation(1e-3)
    state = model.prepare(sphere_on_block())
    probe, depth = model.probe(state), 0.2e-3
    for x in (0.0, 0.2e-3, 0.4e-3, 1.6e-3, 12e-3):
        expected = model.evaluate(state, lowered(depth, x=x)).wrench_on_insert
        np.testing.assert_allclose(probe.at(lowered(depth, x=x)).wrench, expected, 1e-9, 1e-12)


def test_a_probe_finds_columns_of_the_rim_that_the_femur_reaches_from_the_side():
    """The outer wall of the medial rim is met first after a jump of 3 mm, under 9 kN."""
    knee = read_plane()[0]
    state, model = knee.contact.state, ElasticFoundation(1e-3)
    before, after = (
        knee_pose(coordinates)
        for coordinates in (
            [-0.002645365, 0.029851091, -0.002168045, -0.016922425, -0.007409452, 0.816962509],
            [-0.005713722, 0.029191236, -0.001941622, 0.026013009, -0.00879225, 0.914931353],
        )
    )
    probe = model.probe(state)
    probe.at(before)
    expected = model.evaluate(state, after).wrench_on_insert
    np.testing.assert_allclose(probe.at(after).wrench, expected, 1e-9, 1e-9)


def test_a_probe_of_a_result_is_the_probe_at_its_pose():
    model = ElasticFoundation(1e-3)
    state = model.prepare(ContactPair(two_spheres(), flat_insert(HEIGHT, half_z=28e-3), LINEAR))
    result = model.press(state, 1500.0, np.eye(4))
    from_result, at_pose = model.probe(state).seen(result), model.probe(state).at(result.pose)
    assert set(from_result.condyles) == set(at_pose.condyles) == {"medial", "lateral"}
    for side, condyle in from_result.condyles.items():
        np.testing.assert_allclose(condyle.wrench, at_pose.condyles[side].wrench, rtol=1e-12)
        np.testing.assert_allclose(condyle.stiffness, at_pose.condyles[side].stiffness, rtol=1e-9)


def test_first_touch_of_crossed_cylinders_is_found_on_their_edges():
    """Two prisms touch on their edges, where no vertex lies."""
    ridge = dished_insert(lambda x, z: 10e-3 - 0.5 * np.abs(x), spacing=15e-3)
    roof = dished_insert(lambda x, z: 10e-3 - 0.5 * np.abs(z), spacing=15e-3)
    flipped = Surface(roof.vertices * [1, -1, 1], roof.faces[:, ::-1].copy(), "roof")
    assert ContactPair(flipped, ridge, LINEAR).first_touch_height(np.eye(4)) == pytest.approx(
        20e-3, abs=1e-12
    )
    shifted = pose(np.eye(3), [3.1e-3, 0, 2.3e-3])
    pair = ContactPair(flipped, ridge, LINEAR)
    assert pair.first_touch_height(shifted) == pytest.approx(20e-3, abs=1e-12)
    assert pair.pose_at_approach(shifted, 1e-3)[1, 3] == pytest.approx(19e-3, abs=1e-12)


DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.mark.skipif(not DATA.is_dir(), reason="the measured data are missing")
def test_a_real_implant_is_loaded_on_both_dishes():
    """The aligned components of JW, 1500 N: even split, centres of pressure in the dishes."""
    from tkamb.run.press import press_meshes

    folder = DATA / "jw" / "geometry"
    report = press_meshes(
        folder / "femoral_component.stl",
        folder / "tibial_insert.stl",
        1500.0,
        units="m",
        axes="-x,+y,-z",
    )
    result = report.as_dict()
    for name, side in (("medial", -1), ("lateral", 1)):
        condyle = result[name]
        assert condyle["force_N"] == pytest.approx(750, rel=0.03)
        assert side * condyle["cop_mm"][2] == pytest.approx(22, abs=1.5)
        assert abs(condyle["cop_mm"][0]) < 6
        assert 12 < condyle["peak_pressure_MPa"] < 25
        assert 45 < condyle["area_mm2"] < 90


@pytest.mark.parametrize("law", ["linear", "nonlinear"])
@pytest.mark.parametrize("name", ["polyethylene", "polyethylene-linear"])
def test_layer_slope_is_the_derivative_of_the_pressure(law, name):
    chosen, strain, step = material(name), np.array([1e-3, 0.02, 0.1, 0.3]), 1e-6
    ends = [layer_pressure(law, chosen, strain + side * step) for side in (-1, 1)]
    slope = (ends[1] - ends[0]) / (2 * step)
    np.testing.assert_allclose(layer_slope(law, chosen, strain), slope, rtol=1e-5)


@pytest.mark.parametrize("power", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("start", [1e-7, 1e-4, 5e-3])
def test_the_search_for_a_load_returns_its_residual(power, start):
    """Reactions c d^p, with the approach in closed form."""

    def reaction(approach):
        return 1e9 * approach**power

    result = search_load(reaction, 800.0, start)
    assert result.approach == pytest.approx((800.0 / 1e9) ** (1 / power), rel=1e-6)
    assert result.residual == pytest.approx(abs(reaction(result.approach) / 800.0 - 1.0), abs=1e-15)
    assert result.residual <= PRESS.load_tolerance
    assert result.deepest >= result.approach
