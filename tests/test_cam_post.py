"""Cam and post: a second contact pair besides the condyles, in a turned frame."""

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.optimize import brentq

from contact_bodies import joined
from mirrored_patient import mirror_mesh, write_mirrored_patient
from scenes import write_scene
from tkamb import simulate
from tkamb.cli import main
from tkamb.contact.cam_post import CamPost, twist_matrix
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.errors import InputError
from tkamb.geometry.frames import displaced, knee_pose, rotate
from tkamb.geometry.post import divide_insert
from tkamb.geometry.surface import Surface
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee.load import total_wrench, wrench_of
from tkamb.knee.released_forces import external_wrench
from tkamb.run.read_scene import recording_of
from tkamb.run.tabulate import frame_row
from tkamb.studies.designs.design import CAM_MESH, INSERT_MESH, load_design
from tkamb.units import MILLIMETRE

pytestmark = pytest.mark.usefixtures("plain_report")

DESIGN = load_design(Path(__file__).parents[1] / "models" / "designs" / "lps_flex")
LINEAR, CURVED = material("polyethylene-linear"), material("polyethylene")
RADIUS, LENGTH, DEPTH, TALL = 15e-3, 14e-3, 10e-3, 16e-3


def surface(mesh, name):
    vertices, faces = mesh
    return Surface(np.asarray(vertices) * MILLIMETRE, np.asarray(faces, np.int64), name)


@pytest.fixture(scope="module")
def femoral():
    return surface(DESIGN.femoral.mesh_with_cam(), "femoral component")


@pytest.fixture(scope="module")
def insert():
    return surface(DESIGN.insert.mesh(), "insert")


@pytest.fixture(scope="module")
def parts(insert):
    return divide_insert(insert)


def place(flexion_deg, ap_mm=-6.5, rotation_deg=0.0, adduction_deg=0.0, ml_mm=0.0):
    """Return a pose in which the condyles nearly touch the dishes."""
    lengths = np.array([ap_mm, 29.6, ml_mm]) * MILLIMETRE
    return knee_pose([*lengths, *np.radians([rotation_deg, adduction_deg, flexion_deg])])


def cylinder(radius, length):
    """Return a cylinder along z with a fine mesh at its front."""
    turn = np.concatenate([np.linspace(-0.35, 0.35, 141), np.linspace(0.35, 5.933, 41)[1:-1]])
    ring = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    n, ends = len(ring), np.array([-0.5, 0.5]) * length
    sides = [np.column_stack([ring, np.full(n, z)]) for z in ends]
    a, b = np.arange(n), np.roll(np.arange(n), -1)
    walls = [np.column_stack([a, b, b + n]), np.column_stack([a, b + n, a + n])]
    caps = [
        np.column_stack([np.full(n, 2 * n), b, a]),
        np.column_stack([np.full(n, 2 * n + 1), a + n, b + n]),
    ]
    middles = np.array([[0.0, 0.0, z] for z in ends])
    return Surface(np.concatenate([*sides, middles]), np.concatenate([*walls, *caps]), "cylinder")


def cylinder_on_post(model, law=LINEAR, size_mm=1.0, radius=RADIUS):
    """Return a cylinder behind a rectangular post with its posterior face in x = 0."""
    box = trimesh.creation.box((DEPTH, TALL, LENGTH))
    middle = np.array([DEPTH / 2, TALL / 2, 0.0])
    post = Surface(np.asarray(box.vertices) + middle, np.asarray(box.faces, np.int64), "post")
    front = trimesh.creation.box((2e-3, 2e-3, 2e-3))
    ahead = np.array([4 * radius, 0.0, 0.0])
    flange = Surface(np.asarray(front.vertices) + ahead, np.asarray(front.faces, np.int64))
    body = joined(cylinder(radius, 1.2 * LENGTH), flange)
    return CamPost(contact_model(model, resolution=size_mm * 1e-3), body, post, 0.0, law)


def pressed_in(overlap, radius=RADIUS):
    pose = np.eye(4)
    pose[:2, 3] = overlap - radius, TALL / 2
    return pose


def test_the_post_is_divided_from_the_dishes_and_both_stay_closed(insert, parts):
    dishes, post = parts
    for part in parts:
        assert part.mesh.is_watertight
        assert part.mesh.is_winding_consistent
        assert part.mesh.body_count == 1
    before_front = insert.mesh.volume - dishes.mesh.volume - post.mesh.volume
    depth = 2.4e-3  # m, draft that is cut off in front
    assert 0 < before_front < depth * np.prod(np.ptp(post.vertices, axis=0)[1:])
    assert np.ptp(dishes.vertices, axis=0) == pytest.approx([0.0478, 0.0197, 0.074], abs=2e-4)
    assert post.vertices[:, 1].max() == pytest.approx(25e-3, abs=1e-9)
    flat = post.vertices[:, 0] > post.vertices[:, 0].max() - 1e-9
    assert flat.sum() >= 20


@pytest.mark.parametrize(
    ("model", "size_mm", "tolerance"),
    [("foundation", 1.0, 1e-9), pytest.param("lattice", 2.0, 5e-3, marks=pytest.mark.slow)],
)
def test_the_division_does_not_change_the_contact_of_the_condyles(
    femoral, insert, parts, model, size_mm, tolerance
):
    """The cam is far from the post. The lattice's cells change, because the height of the box
    changes.
    """
    dishes, post = parts
    chosen, pose = contact_model(model, resolution=size_mm * 1e-3), place(40.0, -5.4, 3.0)
    pose[1, 3] -= 0.25e-3
    wrenches = []
    for body in (insert, dishes):
        state = chosen.prepare(ContactPair(femoral, body, CURVED))
        wrenches.append(chosen.evaluate(state, pose).wrench_on_insert)
    post_contact = CamPost(chosen, femoral, post, 0.0, CURVED).at(pose)
    assert (post_contact.force == 0).all()
    assert post_contact.gap > 5e-3
    assert wrenches[0][1] < -500
    change = np.abs(wrenches[1] - wrenches[0]) / np.array([1.0, 1.0, 1.0, *[0.025] * 3])
    assert change.max() < tolerance * -wrenches[0][1]


def test_the_cam_engages_where_a_circle_touches_a_line(femoral, parts):
    """Cylinder and plane touch if the distance of the axis is a radius: n . (c - p) = r."""
    cam, posts = DESIGN.femoral.cam, DESIGN.insert.post
    slope = posts.height / posts.draft
    normal = np.array([-slope, 1.0]) / np.hypot(slope, 1.0)
    foot = np.array([posts.posterior, DESIGN.insert.thickness])

    def ap(flexion):
        return -6.0 - 0.02 * (flexion - 60.0)

    def distance(flexion):
        turn, axis = np.radians(flexion), np.array([cam.centre_ap, cam.centre_si])
        rolled = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        centre = np.array([ap(flexion), 29.6]) + rolled @ axis
        return normal @ (centre - foot) - cam.radius

    pair = CamPost(contact_model("foundation"), femoral, parts[1], 0.0, LINEAR)
    result = brentq(
        lambda flexion: pair.at(place(flexion, ap(flexion))).gap, 60.0, 100.0, xtol=1e-4
    )
    assert result == pytest.approx(brentq(distance, 60.0, 100.0), abs=0.01)
    assert (pair.at(place(result - 0.1, ap(result - 0.1))).force == 0).all()
    assert pair.at(place(result + 1.0, ap(result + 1.0))).force[0] > 1.0


def test_a_cylinder_on_the_foundation_has_its_closed_form():
    """p = M d/h under a parabola: F = 4 M w delta a/(3 h), a = sqrt(2 R delta), peak M delta/h."""
    overlap = 0.3e-3
    result = cylinder_on_post("foundation-linear", size_mm=0.5).at(pressed_in(overlap))
    half, stiff = np.sqrt(2 * RADIUS * overlap), LINEAR.confined_modulus / DEPTH
    assert result.force[0] == pytest.approx(4 / 3 * stiff * overlap * half * LENGTH, rel=0.02)
    assert result.peak_pressure == pytest.approx(stiff * overlap, rel=0.01)
    assert result.area == pytest.approx(2 * half * LENGTH, rel=0.05)
    assert result.gap == pytest.approx(-overlap, abs=1e-6)
    assert result.centre == pytest.approx([0.0, TALL / 2, 0.0], abs=1e-5)
    assert np.abs(result.force[1:]).max() < 1e-3 * result.force[0]


def test_work_of_the_cam_is_the_energy_of_the_foundation():
    pair, steps = cylinder_on_post("foundation-linear"), np.linspace(0.0, 0.4e-3, 17)
    work = np.trapezoid([pair.at(pressed_in(d)).force[0] for d in steps], steps)
    last = pair.model.evaluate(pair.state, pair.in_turned @ pressed_in(steps[-1]))
    stored = 0.5 * last.pressure @ (last.area * np.maximum(-last.gap, 0.0))
    assert work == pytest.approx(stored, rel=2e-3)


def test_lattice_and_finite_elements_agree_on_the_post():
    lattice, fe = (
        cylinder_on_post(model, CURVED, 1.0, 30e-3).at(pressed_in(0.15e-3, 30e-3))
        for model in ("lattice", "fe")
    )
    assert lattice.force[0] == pytest.approx(fe.force[0], rel=0.05)
    assert lattice.area == pytest.approx(fe.area, rel=0.05)
    assert lattice.peak_pressure == pytest.approx(fe.peak_pressure, rel=0.05)


@pytest.mark.slow
def test_a_cylinder_on_a_deep_post_is_hertzs_line_contact():
    """Half-width b = 2 sqrt(F R/(pi E*)) and peak 2 F/(pi b), with the force per length F (Johnson
    1985).
    """
    result = cylinder_on_post("lattice-linear", LINEAR, 0.75, 30e-3).at(pressed_in(0.1e-3, 30e-3))
    per_length, strain = result.force[0] / LENGTH, 1.0 - LINEAR.poisson_ratio**2
    half = 2.0 * np.sqrt(per_length * 30e-3 * strain / (np.pi * LINEAR.young_modulus))
    assert result.area == pytest.approx(2.0 * half * LENGTH, rel=0.05)
    assert result.peak_pressure == pytest.approx(2.0 * per_length / (np.pi * half), rel=0.05)


def test_stiffness_is_the_derivative_of_the_wrench(femoral, parts):
    """Central differences of the wrench about the insert's origin, in all six directions; of two
    steps the better one counts, because a column may come into contact."""
    pair = CamPost(contact_model("foundation"), femoral, parts[1], 0.0, CURVED)
    probe, pose = pair.probe(), place(95.0, -6.2, 2.0, 0.5)
    load = probe.at(pose).post
    assert load.force > 500
    for i in range(6):
        errors = []
        for step in (1e-9, 1e-8):
            size, wrenches = step if i < 3 else step / 0.03, []
            for sign in (1, -1):
                moved = displaced(pose, sign * size * np.eye(6)[i])
                wrenches.append(probe.at(moved).post.wrench)
            slope = (wrenches[0] - wrenches[1]) / (2 * size)
            errors.append(np.abs(load.stiffness[:, i] - slope).max() / np.abs(slope).max())
        assert min(errors) < 1e-5, (i, errors)
    assert load.wrench == pytest.approx(np.append(pair.at(pose).force, load.wrench[3:]), rel=1e-9)


def test_power_is_the_same_in_both_frames():
    rng = np.random.default_rng(3)
    pose = knee_pose(rng.normal(size=6))
    point, force, shift, spin = rng.normal(size=(4, 3))
    velocity = shift + np.cross(spin, point)
    turned_twist = twist_matrix(pose) @ np.concatenate([shift, spin])
    moved = rotate(pose, point[None])[0] + pose[:3, 3]
    assert turned_twist[:3] + np.cross(turned_twist[3:], moved) == pytest.approx(
        pose[:3, :3] @ velocity
    )
    assert force @ velocity == pytest.approx((pose[:3, :3] @ force) @ (pose[:3, :3] @ velocity))


@pytest.fixture(scope="module")
def knee(tmp_path_factory):
    """Return a function from released coordinates to the shipped bend with a cam."""
    folder = tmp_path_factory.mktemp("bend")
    DESIGN.write_meshes(folder / "ps")
    changes = {
        "contact__post": True,
        "contact__resolution_mm": 1.5,
        "implant__femoral__mesh": f"../ps/{CAM_MESH}",
        "implant__insert__mesh": f"../ps/{INSERT_MESH}",
    }
    drop = ("quadriceps", "patellar_ligament", "patella")
    case = load_case(load_scene(write_scene(folder / "knee", drop, **changes)))
    recording = recording_of(case)

    def released(*names):
        other = copy.copy(recording)
        other.method = replace(recording.method, released=names, ready_cam=recording.method.cam)
        return other

    released.case = case
    return released


@pytest.mark.parametrize(("released", "k"), [((), 58), (("ap", "adduction"), 80)])
def test_condyles_and_post_together_balance_the_shank(knee, released, k):
    """The wrenches of ground, weight, inertia, ligaments, condyles, post and residuals add up to
    zero.
    """
    recording = knee(*released)
    frame = recording.frame(k)
    geometry, values, friction = frame.geometry, frame.loads.values, recording.knee.friction
    assert not frame.loads.problems
    assert frame.post.force[0] > 100
    tibia, femur = geometry.post
    middle = np.array([0.01, 0.02, 0.03])
    assert total_wrench([tibia], middle) == pytest.approx(-total_wrench([femur], middle))
    row = frame_row(knee.case, k, frame, {}, "ok")
    pushed = [row["post_force_ap_N"], -row["post_force_si_N"], row["post_force_ml_N"]]
    tangential = total_wrench([tibia], middle)[:3] - pushed  # by Coulomb's law
    assert 0.0 < np.linalg.norm(tangential) < 1.001 * friction * row["post_force_N"]
    shank = [load for load in geometry.ligaments if load.link.startswith("tibia")]
    total = external_wrench(geometry, geometry.coordinates)
    total = total + total_wrench([*shank, tibia], np.zeros(3))
    for name, condyle in geometry.condyles.items():
        push = -values[f"{name}_normal"] * condyle.direction(friction)
        total = total + wrench_of(condyle.point, push)
    at = np.mean([condyle.point for condyle in geometry.condyles.values()], axis=0)
    remaining = np.array([values["residual_ap"], 0.0, values["residual_ml"]])
    moment = np.array([0.0, values["residual_axial"], values["residual_flexion"]])
    total = total + wrench_of(at, remaining) + np.append(np.zeros(3), moment)
    assert total == pytest.approx(np.zeros(6), abs=1e-6)
    if not released:
        pressed = -frame.contact.wrench_on_insert[1]
        assert pressed == pytest.approx(frame.loads.contact_force[1], rel=1e-3)
        return
    assert abs(values["residual_ap"]) < 0.1
    assert frame.contact.medial.force == pytest.approx(values["medial_normal"], rel=2e-3)
    assert frame.contact.lateral.force == pytest.approx(values["lateral_normal"], rel=2e-3)


def test_without_friction_the_equations_get_the_wrench_of_the_pair(knee):
    recording = knee()
    load = recording.method.cam.at(place(95.0, -6.2, 2.0)).load
    smooth = replace(recording.instant(58), friction=0.0)
    push, _ = smooth.post_loads(smooth.coordinates, load)
    assert total_wrench([push], np.zeros(3)) == pytest.approx(load.wrench, abs=1e-9)


def test_a_recorded_overlap_is_flagged_and_a_deep_one_fails(knee):
    frame = knee().frame(59)
    assert frame.post.gap < -0.5e-3
    assert any("add 'ap' to [contact] released" in flag for flag in frame.post.flags)
    frame = knee().frame(70)
    assert frame.contact is None
    assert "cam-post contact out of range" in frame.problem
    assert np.isnan(frame.loads.contact_force).all()
    row = frame_row(knee.case, 70, frame, {}, "failed")
    assert np.isnan([row["post_force_N"], row["post_area_mm2"], row["force_si_N"]]).all()


def test_an_insert_without_a_post_is_refused(tmp_path, capsys):
    out = tmp_path / "out"
    scene = write_scene(tmp_path / "knee", contact__post=True)
    assert main(["run", str(scene), "--out", str(out)]) == 2
    message = capsys.readouterr().err.strip().splitlines()
    assert message == ["tkamb: [contact] post: the insert has no post; leave the key out"]
    assert not out.exists()


def test_a_femur_without_cam_and_a_model_without_line_contact_are_refused(femoral, parts):
    with pytest.raises(InputError, match="has no line contact"):
        CamPost(contact_model("hertz"), femoral, parts[1], 0.0, CURVED)
    bare = surface(DESIGN.femoral.mesh(), "femoral component")
    with pytest.raises(InputError, match="has no cam between its condyles"):
        CamPost(contact_model("foundation"), bare, parts[1], 0.0, CURVED)
    with pytest.raises(InputError, match="one condyle has no cam"):
        CamPost(contact_model("foundation"), femoral, parts[1], None, CURVED)


@pytest.mark.slow
def test_a_mirrored_left_knee_gives_the_columns_of_the_right_knee(tmp_path):
    overrides = {"contact.post": True, "contact.released": ["ap", "adduction"]}
    result = []
    for scene in (write_scene(tmp_path / "right"), write_mirrored_patient(tmp_path / "left")):
        DESIGN.write_meshes(tmp_path / "ps")
        for mesh, name in ((CAM_MESH, "femoral_component.stl"), (INSERT_MESH, "insert.stl")):
            if scene.parent.name == "left":
                mirror_mesh(tmp_path / "ps" / mesh)
            (tmp_path / "ps" / mesh).replace(scene.parent / name)
        result.append(simulate(load_scene(scene, overrides), frames=slice(70, 81, 10)))
    right, left = result
    assert right["post_force_ap_N"].min() > 100
    for name in right.columns:
        if name != "status" and not name.endswith("_seconds"):
            scale = max(1.0, float(np.nanmax(np.abs(right[name]), initial=0.0)))
            np.testing.assert_allclose(left[name], right[name], 0, 1e-8 * scale, err_msg=name)
