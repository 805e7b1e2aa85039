"""The cycle of a wear simulation: closing of recorded frames, and rows of a profile."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import shapes
from scenes import write_scene
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.geometry.frames import pose
from tkamb.geometry.surface import Surface
from tkamb.studies.wear.engine import SlidingHistory
from tkamb.studies.wear.laws import Archard
from tkamb.studies.wear.motion import CLOSINGS, CycleMotion, chosen_frames, distance
from tkamb.studies.wear.run import prepare_wear
from tkamb.studies.wear.setup import wear_setup
from tkamb.studies.wear.simulation import first_cycle, simulate_wear
from tkamb.studies.wear.simulator import read_profile
from wear_bodies import MM, balls_scene, plate_case

K, LOAD = 1e-6, 1000.0


def frames(positions, load=LOAD):
    """Return times, poses and loads of translations along x, m, with a frame every 10 ms."""
    positions = np.asarray(positions, float)
    poses = np.repeat(np.eye(4)[None], len(positions), axis=0)
    poses[:, 0, 3] = positions
    return 0.01 * np.arange(len(positions)), poses, np.full(len(positions), load)


def worn(motion):
    state, _ = simulate_wear(plate_case(motion, Archard(K)), 1_000_000, 1)
    return state.volume / MM**3


@pytest.mark.parametrize("apart", [0.0, 0.05, 0.0999, 0.1001, 0.3, 1.0])
def test_the_closing_does_not_depend_on_the_distance_of_the_ends(apart):
    """The motion goes to 10 mm and back to 10 mm times `apart`."""
    positions = np.append(np.linspace(0, 10, 11), np.linspace(10, 10 * apart, 11)[1:]) * MM
    length = 10 * (2 - apart)  # mm as recorded
    expected = {
        "interpolate": length + 10 * apart,
        "there-and-back": 2 * length,
        "as recorded": length,
    }
    for closing in CLOSINGS:
        motion = CycleMotion.of_frames(*frames(positions), closing)
        assert worn(motion) == pytest.approx(K * LOAD * expected[closing] * 1e3, rel=1e-6)
        has_question = closing == "interpolate" and apart > 0.1
        assert bool(motion.questions) is has_question


def test_a_closing_step_is_no_longer_than_the_steps_between_frames():
    motion = CycleMotion.of_frames(*frames(np.linspace(0, 10, 6) * MM))
    steps = [distance(a, b) for a, b in zip(motion.poses[:-1], motion.poses[1:], strict=True)]
    assert max(steps) == pytest.approx(2 * MM)
    assert motion.poses[-1] == pytest.approx(motion.poses[0])


def test_a_cycle_closes_by_a_screw_motion():
    rotated = pose(Rotation.from_euler("z", 40, degrees=True).as_matrix(), [0.01, 0.0, 0.0])
    poses = np.array([np.eye(4), rotated])
    motion = CycleMotion.of_frames(np.array([0.0, 0.1]), poses, np.array([100.0, 300.0]))
    assert motion.load[[1, -1]] == pytest.approx([300.0, 100.0])
    angles = Rotation.from_matrix(motion.poses[1:, :3, :3]).as_euler("zyx", degrees=True)[:, 0]
    assert np.diff(angles) == pytest.approx(np.full(len(angles) - 1, -40 / (len(angles) - 1)))


def test_failed_frames_are_omitted_with_a_note():
    time, poses, load = frames(np.linspace(0, 8, 9) * MM)
    load[4] = np.nan
    assert "1 of 9 frames failed" in CycleMotion.of_frames(time, poses, load).notes[0]
    with pytest.raises(InputError, match="there-and-back"):
        CycleMotion.of_frames(time, poses, load, "there and back")


@pytest.mark.parametrize("count", [2, 3, 20, 101, 102, 173])
@pytest.mark.parametrize("most", [2, 3, 20, 25, 40])
def test_chosen_frames_are_even_and_include_both_ends(count, most):
    chosen = [k for part in chosen_frames(count, most) for k in part]
    assert len(chosen) == min(count, most)
    assert (chosen[0], chosen[-1]) == (0, count - 1)
    assert np.ptp(np.diff(chosen)) <= 1


@pytest.mark.parametrize("closing", CLOSINGS)
def test_fewer_frames_give_the_same_cycle(closing):
    time = np.linspace(0.0, 1.0, 101)
    positions = 6 * MM * np.sin(5 * time) + 1 * MM * np.sin(31 * time)
    recording = frames(positions)
    volumes = []
    for most in (101, 50, 25, 20, 9):
        chosen = [k for block in chosen_frames(101, most) for k in block]
        track = recording[:2] if most < 101 else None
        motion = CycleMotion.of_frames(*(v[chosen] for v in recording), closing, 0.01, track)
        volumes.append(worn(motion))
    assert volumes == pytest.approx([volumes[0]] * len(volumes), rel=1e-3)


def test_time_mean_pressure_follows_uneven_steps():
    """The pressure is 1 MPa for a tenth of the cycle and then falls to zero at once."""
    pressure = np.array([[1e6], [1e6], [0.0], [0.0]])
    poses, up = frames(np.zeros(4))[1], np.array([[0.0, 1.0, 0.0]])
    seconds = np.array([0.1, 1e-9, 0.9])
    history = SlidingHistory.of_cycle(poses, pressure, np.zeros((1, 3)), up, 1, seconds)
    assert history.mean_pressure == pytest.approx([1e5], rel=1e-6)


def test_the_change_with_half_the_frames_shows_too_few_frames():
    """If the load alternates from frame to frame, every second frame is a peak."""

    def change(count, waves):
        time = np.linspace(0.0, 1.0, count)
        positions = 10 * MM * time
        times, poses, _ = frames(positions)
        load = 1000.0 + 500.0 * np.cos(2 * np.pi * waves * time)
        motion = CycleMotion.of_frames(times, poses, load, "as recorded")
        return first_cycle(plate_case(motion, Archard(K)), {}).frames_change

    assert change(21, 10) > 0.3
    assert change(81, 1) < 0.02


def profile(folder, rows):
    path = folder / "profile.csv"
    head = "cycle_percent,axial_force_N,flexion_deg,ap_mm\n"
    path.write_text(head + "".join("{:g},{:g},{:g},{:g}\n".format(*row) for row in rows))
    return path


TRIANGLE = [(5 * k, 1000, 0, 5 * (1 - 2 * abs(2 * k / 20 - 1))) for k in range(21)]
SAWTOOTH = [(0, 1000, 0, 0), (90, 1000, 0, 9), (93, 1000, 0, -2), (100, 1000, 0, 0)]
SPIKE = [(0, 100, 0, 0), (40, 100, 0, 4), (41, 3000, 0, 5), (42, 100, 0, 6), (100, 100, 0, 0)]
UNEVEN = [(0, 500, 0, 0), (1, 500, 0, 3), (2.5, 500, 0, -3), (33.3, 500, 0, 2), (100, 500, 0, 0)]


def exact_work(rows):
    """Return the sum of force times path over linear steps between rows, N·mm."""
    rows = np.array(rows, float)
    return float((0.5 * (rows[1:, 1] + rows[:-1, 1]) * np.abs(np.diff(rows[:, 3]))).sum())


@pytest.mark.parametrize("rows", [TRIANGLE, SAWTOOTH, SPIKE, UNEVEN])
@pytest.mark.parametrize("count", [2, 7, 40])
def test_a_profile_contains_all_rows_of_its_file(tmp_path, rows, count):
    read = read_profile(profile(tmp_path, rows), count)
    indices = [int(np.flatnonzero(np.isclose(read.percent, row[0]))[0]) for row in rows]
    assert read.load[indices] == pytest.approx([row[1] for row in rows])
    assert read.coordinates[indices, 0] / MM == pytest.approx([row[3] for row in rows])
    assert np.diff(read.percent).max() <= 100 / (count - 1) * (1 + 1e-9)
    path = np.abs(np.diff(read.coordinates[:, 0])) / MM
    work = float((0.5 * (read.load[1:] + read.load[:-1]) * path).sum())
    assert work == pytest.approx(exact_work(rows), rel=1e-9)


def lens(radius, half, centre):
    """Return the lower cap of a sphere, mm, with its lowest point at `centre`."""
    r = np.linspace(0, half, 60)
    cap = np.stack([r, radius - np.sqrt(radius**2 - r**2)], 1)
    top = [[half, 12.0], [0.0, 12.0]]
    mesh = trimesh.creation.revolve(np.concatenate([cap, top]), sections=96)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    if mesh.volume < 0:
        mesh.invert()
    mesh.apply_translation(centre)
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64), "lens")


@pytest.fixture(scope="module")
def lenses_scene(tmp_path_factory):
    """Return a scene of two lenses, radius 60 mm, on a block of 50 x 10 x 76 mm."""
    folder = tmp_path_factory.mktemp("lenses")
    scene = write_scene(
        folder,
        drop=("patella", "quadriceps", "patellar_ligament"),
        implant__femoral__mesh="lenses.stl",
        implant__insert__mesh="block.stl",
    )
    pair = shapes.joined(*(lens(60.0, 14.0, (0.0, 10.0, z)) for z in (-22.0, 22.0)))
    trimesh.Trimesh(pair.vertices, pair.faces).export(folder / "lenses.stl")
    block = trimesh.creation.box((50.0, 10.0, 76.0))
    block.apply_translation((0.0, 5.0, 0.0))
    block.export(folder / "block.stl")
    return scene


@pytest.mark.parametrize("rows", [TRIANGLE, SAWTOOTH, SPIKE, UNEVEN])
def test_the_wear_of_a_profile_agrees_with_archard(tmp_path, lenses_scene, rows):
    """The triangle wears 2e-7 mm³/(N m) · 1000 N · 20 mm · 10^6 = 4.000 mm³."""
    run = prepare_wear(
        lenses_scene,
        cycles=1_000_000,
        updates=1,
        law="archard",
        wear_factor=2e-7,
        simulator=profile(tmp_path, rows),
        contact="foundation",
        resolution_mm=2.0,
        frames=12,
    )
    report = run.compute().as_dict()
    expected = 2e-7 * exact_work(rows) * 1e-3 * 1e6
    assert report["volume_mm3"] == pytest.approx(expected, rel=2e-3)
    low, high = report["volume_mm3_range"]
    assert low < report["volume_mm3"] < high
    assert report["frames_change"] < 0.02


def test_the_closing_of_the_command_replaces_that_of_the_scene(tmp_path, capsys):
    scene = balls_scene(tmp_path / "scene")
    text = scene.read_text(encoding="utf-8").replace("there-and-back", "as recorded")
    scene.write_text(text, encoding="utf-8")
    options = {"contact": "foundation", "resolution_mm": 6.0, "frames": 3}
    assert wear_setup(scene, **options).motion.closing == "as recorded"
    assert wear_setup(scene, close="there-and-back", **options).motion.passes == 2
    overridden = wear_setup(scene, overrides={"wear.close": "interpolate"}, **options)
    assert overridden.motion.closing == "interpolate"
    assert main(["wear", str(scene), "--close", "open", "--out", str(tmp_path / "none")]) == 2
    assert "no way 'open' to close a cycle" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_a_closing_of_a_profile_is_refused(tmp_path):
    scene = balls_scene(tmp_path)
    with pytest.raises(InputError, match="already closed"):
        wear_setup(scene, simulator=profile(tmp_path, TRIANGLE), close="interpolate")
