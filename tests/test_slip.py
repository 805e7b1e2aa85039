"""A cylinder that rolls, slides and spins on a plate and in a trough: closed forms of the arcs."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from condyle_profiles import condyle_profile
from surface_arcs import arc_lengths
from tkamb.geometry.condyles import LowestPoints
from tkamb.geometry.frames import Array, inverse, knee_pose, knee_twist, transform
from tkamb.geometry.surface import Surface
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee.slip import (
    CondyleSlip,
    InsertProfile,
    arc,
    condyle_slip,
    femoral_arcs,
    forward_sliding,
    roll_slip_motion,
    sliding_velocity,
)

RADIUS, TROUGH, DEPTH = 0.02, 0.05, 0.012
FRAMES = 61
FLEXION = np.deg2rad(np.linspace(0.0, 60.0, FRAMES))


def test_arcs_of_a_turned_femur_are_their_projection_onto_the_sagittal_plane() -> None:
    """A sphere with 40 deg of axial rotation is flexed in steps of 20 deg: R dθ cos 40°."""
    coordinates = np.zeros((5, 6))
    coordinates[:, 1], coordinates[:, 3] = RADIUS, np.deg2rad(40.0)
    coordinates[:, 5] = np.deg2rad(20.0) * np.arange(5)
    arcs = femoral_arcs(np.zeros((5, 3)), knee_pose(coordinates))
    assert np.abs(arcs) == pytest.approx(RADIUS * np.deg2rad(20.0) * np.cos(np.deg2rad(40.0)))
    assert np.ptp(arcs) < 1e-12


def cylinder() -> Surface:
    mesh = trimesh.creation.cylinder(RADIUS, 0.06, sections=720)
    for _ in range(2):
        mesh = mesh.subdivide()
    vertices = np.array(mesh.vertices)
    return Surface(vertices, np.asarray(mesh.faces), "cylinder")


def bed(trough: bool) -> Surface:
    """Return a block of 60 x 80 mm; its top is flat at 12 mm or a trough of 50 mm radius."""
    x, z = np.linspace(-0.03, 0.03, 241), np.array([-0.04, 0.0, 0.04])
    top = DEPTH + (TROUGH - np.sqrt(TROUGH**2 - x**2) if trough else 0.0 * x)
    rings = [
        np.concatenate(
            [
                np.column_stack([x, top, np.full_like(x, zk)]),
                [[x[-1], 0.0, zk], [x[0], 0.0, zk]],
            ]
        )
        for zk in z
    ]
    n = len(rings[0])
    vertices = np.concatenate([*rings, [[0.0, 0.0, z[0]], [0.0, 0.0, z[-1]]]])
    k = np.arange(n)
    ahead = (k + 1) % n
    faces = []
    for ring in (0, 1):
        a, b = ring * n + k, ring * n + ahead
        faces += [np.column_stack([a, a + n, b]), np.column_stack([b, a + n, b + n])]
    faces.append(np.column_stack([k, ahead, np.full(n, 3 * n)]))
    faces.append(np.column_stack([2 * n + ahead, 2 * n + k, np.full(n, 3 * n + 1)]))
    mesh = trimesh.Trimesh(vertices, np.concatenate(faces), process=False)
    if mesh.volume < 0.0:
        mesh.invert()
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), "bed")


@pytest.fixture(scope="module")
def roller() -> Surface:
    return cylinder()


def motion(ap: Array | float, flexion: Array | float, axial: Array | float = 0.0) -> Array:
    zero = np.zeros(FRAMES)
    columns = [ap + zero, DEPTH + RADIUS + zero, zero, axial + zero, zero, flexion + zero]
    return np.column_stack(columns)


def both(sides: tuple[CondyleSlip, CondyleSlip | None]) -> tuple[CondyleSlip, CondyleSlip]:
    assert sides[1] is not None
    return sides[0], sides[1]


def test_rolling_on_a_plate_has_equal_arcs_and_no_slip(roller: Surface) -> None:
    coordinates = motion(0.01 - RADIUS * FLEXION, FLEXION)
    for side in both(condyle_slip(roller, bed(False), 0.0, coordinates)):
        assert side.femoral_arc[-1] == pytest.approx(RADIUS * FLEXION[-1], rel=1e-3)
        assert side.insert_arc[-1] == pytest.approx(RADIUS * FLEXION[-1], rel=1e-3)
        assert np.abs(side.slip).max() < 1e-3 * side.femoral_arc[-1]


def test_sliding_on_a_plate_is_all_slip(roller: Surface) -> None:
    spinning = motion(0.0, FLEXION)
    pushed = motion(0.01 - 0.02 * FLEXION, 0.0)
    for side in both(condyle_slip(roller, bed(False), 0.0, spinning)):
        assert side.slip[-1] == pytest.approx(RADIUS * FLEXION[-1], rel=1e-3)
        assert np.abs(side.insert_arc).max() < 1e-5
    for side in both(condyle_slip(roller, bed(False), 0.0, pushed)):
        assert side.slip[-1] == pytest.approx(-0.02 * FLEXION[-1], rel=1e-3)


def test_axial_rotation_alone_is_no_slip(roller: Surface) -> None:
    """A rotation of 20 deg about the centre moves the condyles in opposite directions."""
    angle = np.deg2rad(np.linspace(0.0, 20.0, FRAMES))
    medial, lateral = both(condyle_slip(roller, bed(False), 0.0, motion(0.0, 0.0, angle)))
    assert lateral.insert_arc[-1] == pytest.approx(0.015 * np.sin(angle[-1]), rel=2e-3)
    assert medial.insert_arc[-1] == pytest.approx(-0.015 * np.sin(angle[-1]), rel=2e-3)
    for side in (medial, lateral):
        assert side.axial_part[-1] == pytest.approx(side.insert_arc[-1], rel=1e-3)
        assert np.abs(side.slip).max() < 1e-3 * abs(side.insert_arc[-1])


def test_rolling_with_axial_rotation_has_no_slip(roller: Surface) -> None:
    angle = np.deg2rad(np.linspace(0.0, 10.0, FRAMES))
    coordinates = motion(
        0.01 - RADIUS * np.cumsum(np.append(0.0, np.cos(angle[1:]) * np.diff(FLEXION))),
        FLEXION,
        angle,
    )
    for side in both(condyle_slip(roller, bed(False), 0.0, coordinates)):
        assert abs(side.slip[-1]) < 1e-3 * RADIUS * FLEXION[-1]


def test_arcs_in_a_trough_have_their_closed_form(roller: Surface) -> None:
    """The lowest point is below the axis; its projection moves on the trough's arc."""
    ap = np.linspace(0.012, -0.014, FRAMES)
    coordinates = motion(ap, FLEXION)
    coordinates[:, 1] += 5e-3
    expected = TROUGH * (np.arcsin(ap[0] / TROUGH) - np.arcsin(ap / TROUGH))
    for side in both(condyle_slip(roller, bed(True), 0.0, coordinates)):
        assert side.insert_arc[-1] == pytest.approx(expected[-1], rel=1e-3)
        assert side.femoral_arc[-1] == pytest.approx(RADIUS * FLEXION[-1], rel=1e-3)
        assert side.slip[-1] == pytest.approx(RADIUS * FLEXION[-1] - expected[-1], rel=3e-3)


def test_slip_velocity_is_the_rigid_body_velocity(roller: Surface) -> None:
    """Rolling, slip and axial rotation, by arcs and by v + w x r."""
    time = np.linspace(0.0, 1.0, FRAMES)
    angle = np.deg2rad(8.0) * time**2
    coordinates = motion(0.012 - 0.014 * time, FLEXION, angle)
    rates = np.gradient(coordinates, time, axis=0)
    velocity, spin = knee_twist(coordinates, rates)
    for side, z in zip(
        both(condyle_slip(roller, bed(False), 0.0, coordinates)), (-0.015, 0.015), strict=True
    ):
        arm = knee_pose(coordinates)[:, :3, :3] @ np.array([0.0, 0.0, z]) - [0.0, RADIUS, 0.0]
        rigid = sliding_velocity(velocity, spin, arm, arm[:, 2])
        inner = slice(2, -2)
        by_arcs = side.slip_velocity(time)[inner]
        assert np.abs(by_arcs - rigid[inner]).max() < 2e-3 * np.abs(rigid).max()


def test_arc_is_exact_on_a_circle() -> None:
    turn = np.deg2rad(np.array([0.0, 1.0, 30.0, 90.0]))
    chord = np.column_stack([2 * RADIUS * np.sin(turn / 2), np.zeros(4)])
    assert arc(chord, turn) == pytest.approx(RADIUS * turn, rel=1e-12)


def test_the_rolling_of_a_roll_slip_motion_is_recovered(roller: Surface) -> None:
    original = motion(0.01, FLEXION)
    rolled = roll_slip_motion(roller, bed(False), 0.0, original, np.zeros(FRAMES))
    assert rolled[:, 0] == pytest.approx(0.01 - RADIUS * FLEXION, abs=2e-5)
    assert rolled[:, 1] == pytest.approx(DEPTH + RADIUS, abs=2e-6)
    slipped = roll_slip_motion(roller, bed(False), 0.0, original, RADIUS * FLEXION)
    assert slipped[:, 0] == pytest.approx(0.01, abs=2e-5)


def test_rolling_in_a_trough_follows_its_arc_in_steps_of_ten_degrees(roller: Surface) -> None:
    """The error is of second order in the step: Euler's method would miss by 0.1 mm."""
    original = motion(0.02, FLEXION)[::10]
    rolled = roll_slip_motion(roller, bed(True), 0.0, original, np.zeros(len(original)))
    angle = np.arcsin(0.02 / TROUGH) - RADIUS * FLEXION[::10] / TROUGH
    assert rolled[:, 0] == pytest.approx(TROUGH * np.sin(angle), abs=1e-5)


def test_slip_beside_the_insert_is_nan(roller: Surface) -> None:
    coordinates = motion(np.linspace(0.0, -0.05, FRAMES), FLEXION)
    medial, _ = both(condyle_slip(roller, bed(False), 0.0, coordinates))
    assert np.isfinite(medial.slip[:30]).all()
    assert np.isnan(medial.slip[-1])


def test_profile_of_the_trough_has_its_closed_form() -> None:
    x = np.linspace(-0.02, 0.02, 9)
    height, slope = InsertProfile(bed(True)).at(np.column_stack([x, x, 0.01 + 0 * x]))
    assert height == pytest.approx(DEPTH + TROUGH - np.sqrt(TROUGH**2 - x**2), abs=1e-6)
    assert slope == pytest.approx(np.arcsin(x / TROUGH), abs=2e-4)


def test_arcs_agree_with_the_exact_sections() -> None:
    """On the shipped knee, 0 to 120 deg, circular arcs agree with splines along the sections."""
    path = Path(__file__).parents[1] / "models" / "deep_knee_bend" / "scene.toml"
    case = load_case(load_scene(path))
    assert case.femoral is not None
    assert case.insert is not None
    coordinates = case.motion.coordinates
    poses = knee_pose(coordinates)
    side, _ = condyle_slip(case.femoral, case.insert, case.split, coordinates)
    points = np.array([LowestPoints(case.femoral, case.split).at(pose)[0] for pose in poses])
    at_frame = transform(inverse(poses), points[:, None])[:, 0]
    profile = condyle_profile(case.femoral, float(at_frame[:, 2].mean()))
    section = np.ptp(profile.locate(at_frame[[0, -1], :2]))
    assert side.femoral_arc[-1] == pytest.approx(section, rel=5e-3)
    ahead = points[:-1] * [1.0, 1.0, 0.0] + points[0] * [0.0, 0.0, 1.0]
    behind = points[1:] * [1.0, 1.0, 0.0] + points[0] * [0.0, 0.0, 1.0]
    path_length = arc_lengths(case.insert, ahead, behind).sum()
    assert np.abs(np.diff(side.insert_arc)).sum() == pytest.approx(path_length, rel=5e-3)


@pytest.mark.parametrize("seed", range(3))
def test_forward_sliding_is_measured_in_the_sagittal_plane_of_the_centre(seed):
    """The rotation about y does not contribute, also for a point beside the contact."""
    rng = np.random.default_rng(seed)
    place, rates = rng.normal(size=6) * [0.01, 0.01, 0.01, 0.3, 0.3, 0.3], rng.normal(size=6)
    centre, contact = rng.normal(size=3) * 0.02, rng.normal(size=3) * 0.03
    beside = np.append(contact[:2], transform(knee_pose(place), centre)[2])
    on_femur = transform(inverse(knee_pose(place)), beside)
    step = 1e-6
    ahead, behind = (transform(knee_pose(place + s * rates), on_femur) for s in (step, -step))
    expected = (ahead - behind)[0] / (2 * step)
    assert forward_sliding(place, rates, centre, contact) == pytest.approx(expected, abs=1e-8)
