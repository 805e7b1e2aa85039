"""Ligaments over surfaces: closed forms, balance, virtual work, no jump where contact begins."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.integrate import quad

from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import inverse, knee_pose, pose
from tkamb.geometry.surface import Surface
from tkamb.io.scene.parts import wrap_object, wrap_table
from tkamb.io.scene.tables import LigamentWrapTable
from tkamb.knee.contact import displaced
from tkamb.knee.ligament_laws import TwoLine
from tkamb.knee.ligaments import DISTAL, PROXIMAL, BundleArrays, Ligament, ligament_loads
from tkamb.knee.load import LinkPoint, total_wrench
from tkamb.knee.wrap_object import WrapObject, mesh_section

RADIUS, AXES = 0.02, (0.02, 0.03, 0.025)
START, END = np.array([0.005, 0.06, 0.01]), np.array([0.004, -0.06, -0.02])
HERE = {"femur": np.eye(4), "tibia": np.eye(4)}
CYLINDER = WrapObject("cylinder", "tibia", "cylinder", np.eye(4), (RADIUS, 0.4))
ELLIPSOID = WrapObject("ellipsoid", "tibia", "ellipsoid", np.eye(4), AXES)
PLACED = {"femur": (PROXIMAL, np.eye(4)), "tibia": (DISTAL, np.eye(4))}


def bundle(*wraps: WrapObject, start=START, end=END, slack_length: float = 0.11) -> Ligament:
    ends = LinkPoint("femur", np.asarray(start)), LinkPoint("tibia", np.asarray(end))
    return Ligament("MCL", *ends, TwoLine(9e4), slack_length, wraps=wraps)


def section(mesh: trimesh.Trimesh) -> WrapObject:
    surface = Surface(np.array(mesh.vertices), np.array(mesh.faces), name="mesh")
    return mesh_section("mesh", "tibia", surface, np.eye(4))


def helix() -> float:
    """Return the length of the taut string around the cylinder: unrolled, a straight line."""
    near, far = np.hypot(*START[:2]), np.hypot(*END[:2])
    sweep = np.arctan2(START[1], START[0]) - np.arctan2(END[1], END[0])
    arc = sweep - np.arccos(RADIUS / near) - np.arccos(RADIUS / far)
    flat = np.sqrt(near**2 - RADIUS**2) + RADIUS * arc + np.sqrt(far**2 - RADIUS**2)
    return float(np.hypot(flat, END[2] - START[2]))


def ellipse() -> float:
    """Return the length of the string in the plane z = 0 from (0, ±60 mm) around the ellipse."""
    a, b, h = AXES[0], AXES[1], 0.06
    touch = np.arcsin(b / h)  # the tangent through (0, h) touches at y = b² / h
    speed = quad(lambda t: np.hypot(a * np.sin(t), b * np.cos(t)), -touch, touch)[0]
    return float(2.0 * np.hypot(a * np.cos(touch), h - b * np.sin(touch)) + speed)


def test_lengths_are_the_closed_forms_on_solids_and_on_their_meshes():
    # no cap of the mesh cuts its section: the plane z = 0 is far from both ends
    tube = section(trimesh.creation.cylinder(RADIUS, 0.4, sections=256))
    ball = trimesh.creation.icosphere(5)
    ball.apply_transform(np.diag([*AXES, 1.0]))
    # a geodesic of the plane z = 0 stays in this plane of symmetry
    flat = {"start": (0.0, 0.06, 0.0), "end": (0.0, -0.06, 0.0)}
    half = replace(ELLIPSOID, quadrant=(0, 1))
    assert bundle(CYLINDER).length(HERE) == pytest.approx(helix(), rel=1e-12)
    assert bundle(tube).length(HERE) == pytest.approx(helix(), rel=1e-3)
    assert bundle(half, **flat).length(HERE) == pytest.approx(ellipse(), rel=1e-9)
    assert bundle(section(ball), **flat).length(HERE) == pytest.approx(ellipse(), rel=1e-3)


def test_force_on_a_surface_is_that_of_both_straight_parts():
    """The string presses the cylinder with T (u_out - u_in) and pulls the ends with T."""
    one = bundle(replace(CYLINDER, body="shell"))
    tension, loads = ligament_loads([one], HERE | {"shell": np.eye(4)})
    forces = {load.link: load.forces.sum(axis=0) for load in loads}
    assert np.linalg.norm(forces["femur"]) == pytest.approx(tension[0], rel=1e-12)
    assert np.linalg.norm(forces["tibia"]) == pytest.approx(tension[0], rel=1e-12)
    steps = np.diff(one.points(HERE | {"shell": np.eye(4)}), axis=0)
    u = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    np.testing.assert_allclose(forces["shell"], tension[0] * (u[-1] - u[0]), atol=1e-9)
    assert forces["shell"][0] < -0.1 * tension[0]  # towards the axis
    assert np.abs(total_wrench(loads, np.array([0.1, 0.2, 0.3]))).max() < 1e-12 * tension[0]


TUBE = section(trimesh.creation.cylinder(RADIUS, 0.4, sections=64))


@pytest.mark.parametrize("wrap", [CYLINDER, ELLIPSOID, TUBE], ids=lambda wrap: wrap.shape)
@pytest.mark.parametrize("body", ["femur", "tibia"])
def test_work_of_the_pull_is_the_change_of_energy_and_the_tangent_its_slope(wrap, body):
    moved = replace(wrap, body=body)
    arrays = BundleArrays.between([bundle(moved).on_links(PLACED), bundle().on_links(PLACED)])
    here, bodies = knee_pose([0.002, 0.001, -0.001, 0.02, 0.01, 0.05]), np.eye(6)
    wrench = arrays.wrench(here)

    def length(femur):
        return float(bundle(moved).length(HERE | {"femur": femur}))

    straight = bundle()
    for k, size in enumerate([1e-5] * 3 + [1e-4] * 3):
        ahead, behind = (displaced(here, sign * size * bodies[k]) for sign in (1.0, -1.0))
        work = 0.0
        for one, at in ((bundle(moved), length), (straight, None)):
            lengths = [
                at(p) if at else float(one.length(HERE | {"femur": p})) for p in (ahead, behind)
            ]
            tension = float(one.force(one.length(HERE | {"femur": here})))
            work += tension * (lengths[0] - lengths[1]) / (2.0 * size)
        # the femur feels the opposite of the wrench on the tibia
        assert wrench[k] == pytest.approx(work, abs=2e-4 * np.abs(wrench).max())
        slope = (arrays.wrench(ahead) - arrays.wrench(behind)) / (2.0 * size)
        tangent = arrays.tangent(here)[:, k]
        np.testing.assert_allclose(tangent, slope, atol=2e-3 * np.abs(slope).max())


@pytest.mark.parametrize("wrap", [CYLINDER, ELLIPSOID, TUBE], ids=lambda wrap: wrap.shape)
def test_tension_has_no_jump_where_the_string_meets_a_surface(wrap):
    """Steps of 0.1 deg of flexion through the first contact: no step exceeds its neighbours."""
    # Stretched beyond the toe of the law, at whose end the stiffness doubles.
    one = bundle(wrap, start=(0.03, 0.06, 0.005), end=(0.025, -0.05, 0.0), slack_length=0.09)
    angle = np.deg2rad(np.arange(5.0, 25.0, 0.1))
    femur = knee_pose(np.column_stack([np.zeros((len(angle), 5)), angle]))
    poses = {"femur": femur, "tibia": np.eye(4)}
    length, straight = one.length(poses), replace(one, wraps=()).length(poses)
    wrapped = length > straight + 1e-12
    assert 0.2 < wrapped.mean() < 0.8
    tension = one.force(length)
    assert np.abs(np.diff(tension, 2)).max() < 0.05 * np.abs(np.diff(tension)).max()
    assert (length >= straight - 1e-12).all()


def test_an_end_inside_a_surface_is_no_silent_straight_line():
    one = bundle(CYLINDER, start=(0.001, 0.002, 0.0))
    assert np.isnan(one.length(HERE))
    with pytest.raises(ComputationError, match="no taut path over cylinder"):
        ligament_loads([one], HERE)
    with pytest.raises(InputError, match=r"a sphere has 1"):
        WrapObject("ball", "tibia", "sphere", np.eye(4), (0.1, 0.2))


def test_left_mirrors_right_and_a_table_gives_the_same_surface():
    turned = pose(knee_pose([0, 0, 0, 0.3, -0.2, 0.4])[:3, :3], [0.001, 0.002, 0.003])
    mirror = np.diag([1.0, 1.0, -1.0])
    for wrap in (CYLINDER, ELLIPSOID, TUBE):
        placed = replace(wrap, pose=turned, name="one")
        right = bundle(placed)
        left = bundle(placed.mirrored(), start=mirror @ START, end=mirror @ END)
        assert left.length(HERE) == pytest.approx(float(right.length(HERE)), rel=1e-9)
        for is_left in (False, True):
            table = LigamentWrapTable.model_validate(wrap_table(placed, is_left))
            parts = SimpleNamespace(insert=None, femoral=None)
            again = bundle(wrap_object(table, parts, None, is_left))
            assert again.length(HERE) == pytest.approx(float(right.length(HERE)), rel=1e-9)
        assert right.on_links({"femur": ("femur", turned), "tibia": ("tibia", turned)}).length(
            {"femur": inverse(turned), "tibia": inverse(turned)}
        ) == pytest.approx(float(right.length(HERE)), rel=1e-9)
