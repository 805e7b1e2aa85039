"""The patella in a scene: links with its attachments, initial guesses, and lost frames."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from scenes import MODEL, write_scene
from test_patella import INSERTION, knee_at, mechanism  # noqa: F401
from tkamb import simulate
from tkamb.geometry.frames import knee_pose
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee import extensor
from tkamb.knee.chain import ChainMotion
from tkamb.knee.patella import ExtensorMechanism, PatellaStatus
from tkamb.knee.patella_search import solve_patella
from tkamb.run.read_scene import SharedState, _extensor_frames, recording_of

FEW = {"motion.frames": 11, "patella.motion": "solved", "contact.resolution_mm": 3.0}


@pytest.fixture(scope="module")
def plain():
    return read(MODEL / "scene.toml")


def read(path):
    return recording_of(load_case(load_scene(path, FEW)))


def turned_about_y(point):
    return [-point[0], point[1], -point[2]]


def test_attachments_on_a_link_that_is_turned_on_the_patella_stay_where_they_are(plain, tmp_path):
    """Points in the axes of a link that is rotated by 180 deg about y give the same results."""
    points = {
        "quadriceps__insertion": [8.0, 20.0, 0.0],
        "patellar_ligament__proximal": [6.0, -21.0, 0.0],
    }
    path = write_scene(
        tmp_path,
        **{
            key: {"link": "patella_back", "point_mm": turned_about_y(point)}
            for key, point in points.items()
        },
    )
    urdf = path.parent / "patient.urdf"
    link = (
        '<link name="patella_back"/><joint name="patella_back_mount" type="fixed">'
        '<parent link="patella"/><child link="patella_back"/>'
        f'<origin xyz="0 0 0" rpy="0 {np.pi!r} 0"/></joint></robot>'
    )
    urdf.write_text(urdf.read_text(encoding="utf-8").replace("</robot>", link), encoding="utf-8")
    turned = read(path)
    for k in (2, 5, 8):
        one, other = plain.loads(k).loads, turned.loads(k).loads
        assert not one.problems
        assert not other.problems
        for name, value in one.values.items():
            assert other.values[name] == pytest.approx(value, rel=1e-6, abs=1e-5)


@pytest.mark.parametrize("move", [0.02, 0.3, 3.0, 40.0])
def test_slopes_of_a_similar_pose_only_shorten_the_search(mechanism, move):  # noqa: F811
    """Less than a degree away the search needs fewer evaluations. The result is always the same."""
    near = solve_patella(
        mechanism, knee_at(20.0), solve_patella(mechanism, knee_at(19.0)).coordinates
    )
    assert near.slopes is not None
    pose, evaluations = knee_at(20.0 + move), []
    counted = ExtensorMechanism(**vars(mechanism))
    evaluate = counted.contact.at
    object.__setattr__(counted, "contact", counted.contact.unused())
    counted.contact.at = lambda coordinates: (
        evaluations.append(coordinates) or evaluate(coordinates)
    )
    slow = solve_patella(counted, pose, near.coordinates)
    slow_evaluations = len(evaluations)
    quick = solve_patella(counted, pose, near.coordinates, near.slopes)
    assert quick.coordinates == pytest.approx(slow.coordinates, abs=2e-7)
    assert quick.patellofemoral_ratio == pytest.approx(slow.patellofemoral_ratio, abs=1e-6)
    if move < 1.0:
        assert len(evaluations) - slow_evaluations <= 0.6 * slow_evaluations


@pytest.mark.parametrize("wild", [[0.0, 0.0, 2.5], [0.045, 0.3, -3.0]])
def test_a_wrong_guess_does_not_lose_the_patella(mechanism, wild):  # noqa: F811
    """If the guess fails, the result is that of a search without a guess."""
    cold = solve_patella(mechanism, knee_at(25.0))
    warm = solve_patella(mechanism, knee_at(25.0), np.array(wild))
    assert warm.status is PatellaStatus.OK
    assert np.allclose(warm.coordinates, cold.coordinates, atol=1e-6)


def test_a_guess_inside_the_outline_of_the_femur_does_not_lose_the_patella(mechanism):  # noqa: F811
    """At the guess an end of the quadriceps lies inside the outline; a full search converges."""
    angle = np.linspace(0.0, 2 * np.pi, 181)[:-1]
    outline = 0.026 * np.column_stack([np.cos(angle), np.sin(angle)])
    wrapped = ExtensorMechanism(**{**vars(mechanism), "femoral_outline": outline})
    inside = np.append(-INSERTION[:2], 0.0)  # this puts the insertion on the axis of the trochlea
    cold, warm = (solve_patella(wrapped, knee_at(25.0), guess) for guess in (None, inside))
    assert warm.status is PatellaStatus.OK
    assert np.allclose(warm.coordinates, cold.coordinates, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "conditions"),
    [
        ({"ligament_length": 0.005}, (PatellaStatus.NO_CONTACT, PatellaStatus.LIGAMENT)),
        ({"ligament_length": 0.4}, (PatellaStatus.NO_CONTACT,)),
        ({"muscle_origin": np.array([0.028, -0.22, 0.0])}, (PatellaStatus.MOMENT,)),
    ],
)
def test_the_condition_that_fails_is_named(mechanism, change, conditions):  # noqa: F811
    state = solve_patella(ExtensorMechanism(**{**vars(mechanism), **change}), knee_at(20.0))
    assert state.status in conditions
    assert np.isnan(state.coordinates).all()


def test_a_frame_that_loses_the_patella_fails_and_the_run_goes_on(plain, monkeypatch):
    """The status of lost frame 5 states reason and flexion. The other frames change little."""
    scene = load_scene(MODEL / "scene.toml", FEW | {"contact.model": "foundation"})
    poses = []

    def losing(parts, pose, *near):
        poses.append(pose)
        state = solve_patella(parts, pose, *near)
        if len(poses) != 6:
            return state
        return replace(state, coordinates=np.full(3, np.nan), status=PatellaStatus.MOMENT)

    monkeypatch.setattr(extensor, "solve_patella", losing)
    results = simulate(scene)
    status = results["status"]
    flexion = results["flexion_deg"][5]
    assert re.match(rf"failed: patella lost at {flexion:.1f} deg of flexion: the moment", status[5])
    assert np.isnan(results["force_total_N"][5])
    others = [k for k in range(11) if k != 5]
    assert not any(status[k].startswith("failed") for k in others)
    quadriceps = [plain.loads(k).loads.values["muscle_quadriceps"] for k in others]
    assert np.allclose(results["quadriceps_N"][others], quadriceps, atol=0.5)


def test_a_sample_searches_from_the_nominal_patella_and_keeps_its_rates(plain):
    """At equal poses the result is equal. At other poses a full search gives the same result."""
    frames = plain.extensor
    same = frames.moved(frames.lines, plain.poses, range(2, 5))
    for k in range(11):
        np.testing.assert_allclose(same.joints(k), frames.joints(k), rtol=0, atol=1e-6)
    bent = plain.motion.coordinates + np.array([1e-3, 0.0, 0.0, 0.0, 0.0, 0.02])
    moved = frames.moved(frames.lines, knee_pose(bent), range(2, 5))
    for k in (2, 4):
        alone = solve_patella(frames.lines.mechanism, knee_pose(bent)[k])
        np.testing.assert_allclose(moved.states[k].coordinates, alone.coordinates, atol=1e-6)
        change = alone.coordinates - frames.states[k].coordinates
        assert np.abs(change).max() > 1e-4
        np.testing.assert_allclose(moved.joints(k)[0] - frames.joints(k)[0], change, atol=1e-6)
        np.testing.assert_array_equal(moved.joints(k)[1:], frames.joints(k)[1:])
    np.testing.assert_array_equal(moved.joints(6), frames.joints(6))


def test_a_sample_passes_on_only_the_coordinates_of_a_recorded_patella(plain):
    """The motion's file has coordinates of the patella in both cases."""
    moved = SimpleNamespace(moved=lambda *given: given[-1])
    shared = SharedState(None, None, moved, range(1))
    case = load_case(load_scene(MODEL / "scene.toml", FEW))
    assert _extensor_frames(case, plain.knee, plain.poses, shared) is None
    patella = case.scene.patella.model_copy(update={"motion": "recorded"})
    scene = case.scene.model_copy(update={"patella": patella})
    given = _extensor_frames(replace(case, scene=scene), plain.knee, plain.poses, shared)
    assert given is case.motion.patella


def test_the_patella_stays_at_its_equilibrium_and_its_rates_are_filtered():
    """The filter does not change coordinates: the gap is zero, and the ligament has its length.

    The scene's chain without tkamb.Knee has the same coordinates and inertial forces.
    """
    case = load_case(load_scene(MODEL / "scene.toml", FEW | {"motion.cutoff_Hz": 1.0}))
    recording, motion, tibia = recording_of(case), case.motion, case.tibia
    solved = np.array([state.coordinates for state in recording.extensor.states])
    filtered, velocity, acceleration = case.rates(motion.time, solved)
    assert np.abs(filtered - solved).max() > 1e-5  # m, rad
    for k in (3, 8):
        knee = np.stack([motion.coordinates[k], motion.velocity[k], motion.acceleration[k]])
        patella = recording.extensor.joints(k)
        np.testing.assert_array_equal(patella[0], solved[k])
        np.testing.assert_allclose(patella[1:], [velocity[k], acceleration[k]], rtol=1e-12)
        joints = np.hstack([knee, patella])
        shank = (tibia.pose[k], tibia.velocity[k], tibia.acceleration[k])
        recorded, geometry = case.chain.at(ChainMotion(*shank, joints)), recording.geometry(k)
        state = geometry.state
        for link in ("femur", "patella"):
            np.testing.assert_allclose(state.pose(link), recorded.pose(link), rtol=0, atol=1e-9)
        forces = [
            one.inertial[one.chain.knee_columns() + one.chain.patella_columns()]
            for one in (state, recorded)
        ]
        np.testing.assert_allclose(*forces, rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(recording.instant(k).coordinates, motion.coordinates[k])
        _, ligament = recording.extensor.lines.paths(state)
        assert ligament.length == pytest.approx(case.patellar_ligament.length, abs=1e-7)
        touch = recording.extensor.lines.given(recording.poses[k], patella[0])
        assert abs(touch.gap) < 1e-7


def test_the_moments_of_three_forces_on_the_patella_add_up_to_zero(plain):
    """The moments of quadriceps, patellar ligament and contact about the femur's z sum to zero."""
    for k in (3, 9):
        state, patella = plain.geometry(k).state, plain.extensor.states[k]
        muscle, ligament = plain.extensor.lines.paths(state)
        ligament_force = patella.ligament_ratio * ligament.start_direction
        contact_force = patella.patellofemoral_ratio * patella.contact_normal
        points = np.stack([muscle.points[-1], ligament.points[0], patella.contact_point])
        forces = np.stack([-muscle.end_direction, ligament_force, contact_force])
        moments = np.cross(points - state.pose("femur")[:3, 3], forces) @ state.pose("femur")[:3, 2]
        assert np.abs(moments).min() > 1e-4
        assert moments.sum() == pytest.approx(0.0, abs=1e-6)
