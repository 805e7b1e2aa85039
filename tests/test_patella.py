"""The solved patella against the exact three-force solution on a circular trochlea."""

from pathlib import Path

import fcl
import numpy as np
import pytest
import trimesh
from scipy.optimize import fsolve

from tkamb.geometry.frames import Array, inverse, knee_pose, transform
from tkamb.geometry.surface import Surface
from tkamb.io import starter as starter_package
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee.patella import (
    ExtensorMechanism,
    PatellaState,
    PatellaStatus,
    patella_at,
)
from tkamb.knee.patella_search import solve_patella
from tkamb.knee.patellofemoral import PatellofemoralContact
from tkamb.run.read_scene import recording_of

TROCHLEA, DOME = 0.025, 0.02
CENTRE = np.array([0.004, 0.0, 0.0])
ORIGIN, INSERTION = np.array([0.028, 0.22, 0.0]), np.array([0.008, 0.02, 0.0])
PROXIMAL, TUBEROSITY = np.array([0.006, -0.02, 0.0]), np.array([0.04, -0.065, 0.0])
LENGTH = 0.065


def surface(mesh: trimesh.Trimesh, name: str) -> Surface:
    return Surface(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64), name)


def dome() -> Surface:
    """Return a spherical cap that faces -x, with its centre at CENTRE in the patella's frame."""
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=DOME)
    vertices = np.array(mesh.vertices)
    vertices[:, 0] = np.minimum(vertices[:, 0], 0.004)
    return surface(trimesh.Trimesh(vertices + CENTRE, mesh.faces, process=False), "button")


def translation(x: float, y: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, 3] = x, y
    return pose


def cylinder() -> Surface:
    return surface(trimesh.creation.cylinder(TROCHLEA, 0.08, sections=360), "trochlea")


def groove(half_angle: float = 1.3) -> Surface:
    """Return a V-shaped trochlea: two cones of revolution about z that meet in the groove."""
    slope = 1.0 / np.tan(half_angle)
    z = np.array([0.0, 0.02, 0.02, -0.02, -0.02])
    r = np.array([0.02, 0.02 + 0.02 * slope, 0.0, 0.0, 0.02 + 0.02 * slope])
    around = np.linspace(0.0, 2 * np.pi, 361)[:-1]
    ring = np.stack([np.cos(around), np.sin(around)], axis=1)
    vertices = np.array(
        [[rk * c, rk * s, zk] for rk, zk in zip(r, z, strict=True) for c, s in ring]
    )
    faces = []
    for k in range(5):
        a, b = k * 360 + np.arange(360), ((k + 1) % 5) * 360 + np.arange(360)
        faces += [
            np.column_stack([a, np.roll(a, -1), b]),
            np.column_stack([np.roll(a, -1), np.roll(b, -1), b]),
        ]
    mesh = trimesh.Trimesh(vertices, np.concatenate(faces), process=False)
    if mesh.volume < 0:
        mesh.invert()
    return surface(mesh, "groove")


@pytest.fixture(scope="module")
def mechanism() -> ExtensorMechanism:
    return ExtensorMechanism(
        PatellofemoralContact(cylinder(), dome()),
        np.eye(4),
        ORIGIN,
        INSERTION,
        PROXIMAL,
        TUBEROSITY,
        LENGTH,
    )


def knee_at(flexion_deg: float) -> Array:
    return knee_pose([0.0, TROCHLEA, 0.0, 0.0, 0.0, np.deg2rad(flexion_deg)])


def three_force(flexion_deg: float, guess: Array) -> tuple[Array, float, float]:
    """Return coordinates (3,), PL/Q and PF/Q with which the three forces meet in one point."""
    tuberosity = transform(inverse(knee_at(flexion_deg)), TUBEROSITY)[:2]

    def points_at(unknown: Array) -> tuple[Array, Array, Array, Array]:
        angle, rotation = unknown
        radial = np.array([np.cos(angle), np.sin(angle)])
        rotation_matrix = np.array(
            [[np.cos(rotation), -np.sin(rotation)], [np.sin(rotation), np.cos(rotation)]]
        )
        position = (TROCHLEA + DOME) * radial - rotation_matrix @ CENTRE[:2]
        return (
            position,
            radial,
            position + rotation_matrix @ INSERTION[:2],
            position + rotation_matrix @ PROXIMAL[:2],
        )

    def errors(unknown: Array) -> list[float]:
        _, radial, insertion, proximal = points_at(unknown)
        muscle, patellar = ORIGIN[:2] - insertion, tuberosity - proximal
        intersection = (
            insertion
            + muscle
            * np.linalg.solve(np.column_stack([muscle, -patellar]), proximal - insertion)[0]
        )
        return [
            100 * (np.linalg.norm(patellar) - LENGTH),
            100 * (intersection[0] * radial[1] - intersection[1] * radial[0]),
        ]

    at_guess = guess[:2] + CENTRE[:2]
    angle, rotation = fsolve(errors, [np.arctan2(at_guess[1], at_guess[0]), guess[2]], xtol=1e-13)
    position, radial, insertion, proximal = points_at(np.array([angle, rotation]))
    muscle, patellar = ORIGIN[:2] - insertion, tuberosity - proximal
    muscle, patellar = (
        muscle / np.linalg.norm(muscle),
        patellar / np.linalg.norm(patellar),
    )
    ligament, normal = np.linalg.solve(np.column_stack([patellar, radial]), -muscle)
    return np.append(position, rotation), float(ligament), float(normal)


def solved(mechanism: ExtensorMechanism, angles: list[float]) -> list[PatellaState]:
    states: list[PatellaState] = []
    for angle in angles:
        guess = states[-1].coordinates if states else None
        states.append(solve_patella(mechanism, knee_at(angle), guess))
    return states


def test_circular_trochlea_is_the_three_force_solution(mechanism: ExtensorMechanism) -> None:
    angles = [0.0, 10.0, 20.0, 30.0, 40.0]
    states = solved(mechanism, angles)
    assert all(state.status is PatellaStatus.OK for state in states)
    for angle, state in zip(angles, states, strict=True):
        exact, ligament, normal = three_force(angle, state.coordinates)
        assert np.abs(state.coordinates[:2] - exact[:2]).max() < 5e-5
        assert abs(state.coordinates[2] - exact[2]) < np.deg2rad(0.15)
        assert state.ligament_ratio == pytest.approx(ligament, rel=3e-3)
        assert state.patellofemoral_ratio == pytest.approx(normal, rel=3e-3)


def test_the_contact_moves_superior_on_the_patella(mechanism: ExtensorMechanism) -> None:
    height = [s.contact_on_patella[1] for s in solved(mechanism, [0.0, 10.0, 20.0, 30.0, 40.0])]
    assert (np.diff(height) > 0.0).all()


def test_the_solution_satisfies_the_conditions_from_any_guess(mechanism: ExtensorMechanism) -> None:
    cold = solve_patella(mechanism, knee_at(25.0))
    guess = cold.coordinates + np.array([1e-3, -1e-3, 0.05])
    warm = solve_patella(mechanism, knee_at(25.0), guess)
    assert np.abs(warm.coordinates - cold.coordinates).max() < 1e-5
    assert abs(cold.gap) < 1e-7
    pose = mechanism.contact.pose(cold.coordinates)
    tuberosity = transform(inverse(knee_at(25.0)), TUBEROSITY)
    assert np.linalg.norm(transform(pose, PROXIMAL) - tuberosity) == pytest.approx(LENGTH, abs=1e-7)


def test_the_quadriceps_is_shortest_at_equilibrium(mechanism: ExtensorMechanism) -> None:
    """By virtual work, rotation at constant gap and ligament length lengthens the muscle."""
    from tkamb.knee.patella_search import _Search

    state = solve_patella(mechanism, knee_at(25.0))
    frame = _Search(mechanism, knee_at(25.0))
    turn = np.deg2rad(4.0)
    lengths = []
    for step in (-turn, 0.0, turn):
        balance = frame.at_rotation(state.coordinates, float(state.coordinates[2] + step))
        assert balance is not None
        lengths.append(balance.muscle.length)
    assert lengths[1] < min(lengths[0], lengths[2])
    slope = (lengths[2] - lengths[0]) / (2 * turn)
    curvature = (lengths[2] - 2 * lengths[1] + lengths[0]) / turn**2
    assert abs(slope / curvature) < np.deg2rad(0.3)


@pytest.mark.parametrize("aside", [-0.05, 0.05])
def test_a_button_may_lie_anywhere_on_its_patella(aside: float) -> None:
    """If the button shifts along y and the patella shifts back, the contact does not change."""
    plain = PatellofemoralContact(cylinder(), dome())
    moved = PatellofemoralContact(cylinder(), dome().moved(translation(0.0, aside)))
    at = np.array([TROCHLEA + DOME - 0.004, 0.0, 0.0])
    plain_state, moved_state = plain.at(at), moved.at(at - [0.0, aside, 0.0])
    assert moved_state.gap == pytest.approx(plain_state.gap, abs=1e-6)
    assert moved_state.normal == pytest.approx(plain_state.normal, abs=1e-3)


def test_the_shift_on_a_slope_is_the_yield_times_its_sine() -> None:
    """A plane that faces forward and 20 deg to the right has n_z = sin 20 deg everywhere."""
    slope = np.deg2rad(20.0)
    wall = trimesh.creation.box([0.02, 0.2, 0.2])
    wall.apply_translation([-0.01, 0.0, 0.0])
    wall.apply_transform(trimesh.transformations.rotation_matrix(-slope, [0, 1, 0]))
    contact = PatellofemoralContact(surface(wall, "wall"), dome(), lateral_yield=0.01)
    state = contact.at(np.array([DOME / np.cos(slope) - CENTRE[0], 0.0, 0.0]))
    assert state.shift == pytest.approx(0.01 * np.sin(slope), rel=1e-9)
    assert state.normal == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)


def test_the_point_lies_on_the_line_of_action_of_both_facets() -> None:
    """The moments about z add up for a wall across x and a wall rotated by 30 deg, 6 mm higher."""
    size, turns, rises = 0.008, np.deg2rad([0.0, 30.0]), np.array([0.0, 0.006])
    walls, caps = [], []
    for turn, rise, side in zip(turns, rises, (-0.01, 0.01), strict=True):
        wall = trimesh.creation.box([0.02, 0.04, 0.016])
        wall.apply_translation([-0.01 - size, 0.0, 0.0])
        wall.apply_transform(trimesh.transformations.rotation_matrix(turn, [0, 0, 1]))
        cap = trimesh.creation.icosphere(subdivisions=5, radius=size)
        walls.append(wall.apply_translation([0.0, rise, side]))
        caps.append(cap.apply_translation([0.0, rise, side]))
    femoral, button = (surface(trimesh.util.concatenate(m), "pair") for m in (walls, caps))
    state = PatellofemoralContact(femoral, button).at(np.zeros(3))
    share = np.array([state.share_left, 1.0 - state.share_left])
    assert share.min() > 0.05
    force = share @ np.stack([np.cos(turns), np.sin(turns)], axis=1)
    moment = -share @ (rises * np.cos(turns))
    assert state.normal[:2] == pytest.approx(force / np.linalg.norm(force), abs=1e-9)
    arm = state.point[0] * state.normal[1] - state.point[1] * state.normal[0]
    assert arm == pytest.approx(moment / np.linalg.norm(force), abs=3e-5)


def test_gap_is_the_distance_of_the_closest_points() -> None:
    """python-fcl gives the same gap of 0.2 to 2 mm between dome and cylinder."""
    contact = PatellofemoralContact(cylinder(), dome())
    trees = []
    for part in (cylinder(), dome()):
        tree = fcl.BVHModel()
        tree.beginModel(len(part.vertices), len(part.faces))
        tree.addSubModel(part.vertices, part.faces)
        tree.endModel()
        trees.append(tree)
    for gap in (2e-4, 1e-3, 2e-3):
        for angle in (-0.5, 0.0, 0.4):
            out = np.array([np.cos(angle), np.sin(angle)])
            at = np.append((TROCHLEA + DOME + gap) * out - [0.004, 0.0], 0.0)
            pose = contact.pose(at)
            button = fcl.CollisionObject(trees[1], fcl.Transform(pose[:3, :3], pose[:3, 3]))
            distance = fcl.distance(fcl.CollisionObject(trees[0]), button)
            assert contact.at(at).gap == pytest.approx(distance, abs=1.5e-5)
            assert contact.at(at).normal[:2] == pytest.approx(out, abs=5e-3)


def test_a_prepared_contact_used_again_gives_the_same_result() -> None:
    first, coordinates = (
        PatellofemoralContact(cylinder(), dome()),
        ([0.046, 0.0, 0.1], [0.04, 0.02, 0.0]),
    )
    first.at(coordinates[0])
    again, new = first.unused().at(coordinates[1]), PatellofemoralContact(cylinder(), dome())
    fresh = new.at(coordinates[1])
    assert again.gap == fresh.gap
    np.testing.assert_array_equal(again.point, fresh.point)
    np.testing.assert_array_equal(again.normal, fresh.normal)


def test_coordinates_that_are_nan_have_no_gap_and_are_not_stored() -> None:
    contact = PatellofemoralContact(cylinder(), dome())
    touching = np.array([TROCHLEA + DOME - CENTRE[0], 0.0, 0.0])
    gap = contact.at(touching).gap
    for axis in range(3):
        nowhere = touching.copy()
        nowhere[axis] = np.nan
        assert np.isnan(contact.at(nowhere).gap)
        assert contact.at(touching).gap == gap


def test_gap_is_smooth_through_touch() -> None:
    contact = PatellofemoralContact(cylinder(), dome())
    x = TROCHLEA + DOME - 0.004 + np.linspace(-5e-4, 5e-4, 21)
    gap = np.array([contact.at(np.array([xi, 0.0, 0.0])).gap for xi in x])
    assert np.diff(gap) == pytest.approx(np.diff(x), rel=1e-3)


def test_groove_shares_the_force_and_never_jumps() -> None:
    """A centred button has equal forces on both sides. The share changes smoothly off centre."""
    shares, normals, bodies = [], [], (groove(), dome())
    for beside in np.linspace(-2e-3, 2e-3, 21):
        contact = PatellofemoralContact(*bodies, ml=float(beside))
        state = contact.at(np.array([0.0368, 0.0, 0.0]))
        shares.append(state.share_left)
        normals.append(state.normal)
    assert shares[10] == pytest.approx(0.5, abs=0.01)
    assert np.abs(np.diff(shares)).max() < 0.25
    assert np.abs(np.diff(normals, axis=0)).max() < 0.02
    assert (np.diff(shares) * (shares[-1] - shares[0]) >= -1e-6).all()


def test_a_recorded_patella_keeps_its_gap(mechanism: ExtensorMechanism) -> None:
    coordinates = np.array([TROCHLEA + DOME - 0.004 + 1e-3, 0.0, 0.0])
    state = patella_at(mechanism, knee_at(0.0), coordinates, mechanism.contact.at(coordinates))
    assert state.gap == pytest.approx(1e-3, abs=1e-5)
    assert (state.coordinates == coordinates).all()


def test_a_patella_whose_ligament_is_too_short_is_not_found(mechanism: ExtensorMechanism) -> None:
    short = ExtensorMechanism(**{**vars(mechanism), "ligament_length": 0.005})
    state = solve_patella(short, knee_at(20.0))
    assert state.status in (PatellaStatus.NO_CONTACT, PatellaStatus.LIGAMENT)
    assert not state.status.found
    assert np.isnan(state.coordinates).all()


def test_a_contact_on_the_end_of_the_femoral_mesh_is_reported(mechanism: ExtensorMechanism) -> None:
    """The trochlea ends at y = -5 mm. Contact below this end is on the edge of the mesh."""
    trochlea = cylinder()
    faces = trochlea.faces[(trochlea.triangles[:, :, 1] > -5e-3).all(axis=1)]
    contact = PatellofemoralContact(Surface(trochlea.vertices, faces, "cut"), dome())
    cut = ExtensorMechanism(**{**vars(mechanism), "contact": contact})
    states = [solve_patella(cut, knee_at(angle)) for angle in (0.0, 40.0)]
    assert states[0].status is PatellaStatus.OK
    assert states[1].status is PatellaStatus.EDGE or not states[1].status.found


@pytest.fixture(scope="module")
def shipped() -> tuple[Array, list[PatellaState]]:
    """Flexion (deg) and patella of every frame of the shipped deep knee bend."""
    path = Path(__file__).parents[1] / "models" / "deep_knee_bend" / "scene.toml"
    case = load_case(load_scene(path, {"patella.motion": "solved"}))
    frames = recording_of(case, near=True).extensor
    return np.rad2deg(case.motion.coordinates[:, 5]), frames.states


def test_shipped_knee_has_the_published_force_ratios(
    shipped: tuple[Array, list[PatellaState]],
) -> None:
    """Q/PL 0.9-1.1 near extension, 1.3-1.9 at 70-100 deg (cadaver studies); not tuned."""
    flexion, states = shipped
    assert all(state.status is PatellaStatus.OK for state in states)
    ratio = np.array([1.0 / state.ligament_ratio for state in states])
    assert ((ratio > 0.9) & (ratio < 1.1))[flexion < 20.0].all()
    assert ((ratio > 1.3) & (ratio < 1.9))[(flexion > 70.0) & (flexion < 100.0)].all()


def test_shipped_contact_moves_superior_until_the_quadriceps_wraps(
    shipped: tuple[Array, list[PatellaState]],
) -> None:
    flexion, states = shipped
    height = np.array([state.contact_on_patella[1] for state in states])
    before = height[flexion < 60.0]
    assert before[-1] - before[0] > 4e-3
    assert np.diff(before).min() > -5e-4
    assert height[-1] > before[0] + 4e-3


def test_shipped_patella_moves_smoothly(shipped: tuple[Array, list[PatellaState]]) -> None:
    """Second differences over 101 frames exceed 0.1 deg only at the kink where wrapping starts."""
    coordinates = np.array([state.coordinates for state in shipped[1]])
    bend = np.abs(np.diff(coordinates, n=2, axis=0)).max(axis=0)
    assert (bend[:2] < 2e-4).all()
    assert bend[2] < np.deg2rad(0.4)


def test_a_patella_lost_from_a_distant_guess_is_found_from_its_own_frame():
    """The search for frame 0 fails from the last frame and converges from frame 0."""
    starter = Path(starter_package.__file__).parent / "files" / "scene.toml"
    recording = recording_of(load_case(load_scene(starter)))
    extensor, pose = recording.extensor, recording.poses[0]
    frame_state, last_state = extensor.states[0], extensor.states[-1]
    lost = solve_patella(extensor.lines.mechanism, pose, last_state.coordinates, last_state.slopes)
    assert not lost.status.found
    state = extensor.patella(0, pose, last_state)
    assert state.status.found
    np.testing.assert_allclose(state.coordinates, frame_state.coordinates, atol=1e-6)


def test_a_recorded_contact_does_not_depend_on_earlier_evaluations(
    mechanism: ExtensorMechanism,
) -> None:
    """A part of a motion therefore has exactly the results of the complete motion."""
    coordinates = [np.array([0.05 + 1e-4 * k, 1e-3 * k, 0.02 * k]) for k in range(8)]
    contact = mechanism.contact.unused()
    after_others = [contact.at(row) for row in coordinates][-1]
    alone = mechanism.contact.unused().at(coordinates[-1])
    assert vars(alone).keys() == vars(after_others).keys()
    for name, value in vars(alone).items():
        np.testing.assert_array_equal(vars(after_others)[name], value)
