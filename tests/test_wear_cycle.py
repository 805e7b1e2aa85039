"""What a cycle of wear is: how recorded frames close, and which rows of a profile are computed."""

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
from tkamb.studies.wear.laws import Archard
from tkamb.studies.wear.motion import CLOSINGS, CycleMotion, chosen_frames, distance
from tkamb.studies.wear.run import prepare_wear
from tkamb.studies.wear.setup import wear_setup
from tkamb.studies.wear.simulation import first_cycle, simulate_wear
from tkamb.studies.wear.simulator import read_profile
from tkamb.studies.wear.sliding import SlidingHistory
from wear_bodies import MM, balls_scene, plate_case

K, LOAD = 1e-6, 1000.0


def frames(places, load=LOAD):
    """Translations along x (f,) m, a frame every 10 ms."""
    places = np.asarray(places, float)
    poses = np.repeat(np.eye(4)[None], len(places), axis=0)
    poses[:, 0, 3] = places
    return 0.01 * np.arange(len(places)), poses, np.full(len(places), load)


def worn(motion):
    """Volume of a cycle on a plate under a load that is spread over all of it, mm³ by 1e6."""
    state, _ = simulate_wear(plate_case(motion, Archard(K)), 1_000_000, 1)
    return state.volume / MM**3


@pytest.mark.parametrize("apart", [0.0, 0.05, 0.0999, 0.1001, 0.3, 1.0])
def test_how_far_apart_the_ends_are_never_changes_how_a_cycle_closes(apart):
    """10 mm out and back to `apart` of it: path 2·10 mm closed, twice the way there and back."""
    out = np.append(np.linspace(0, 10, 11), np.linspace(10, 10 * apart, 11)[1:]) * MM
    way = 10 * (2 - apart)  # mm as recorded
    expected = {"interpolate": way + 10 * apart, "there-and-back": 2 * way, "as recorded": way}
    for closing in CLOSINGS:
        motion = CycleMotion.of_frames(*frames(out), closing)
        assert worn(motion) == pytest.approx(K * LOAD * expected[closing] * 1e3, rel=1e-6)
        asked = closing == "interpolate" and apart > 0.1
        assert bool(motion.questions) is asked


def test_a_closing_step_is_no_longer_than_the_steps_between_frames():
    motion = CycleMotion.of_frames(*frames(np.linspace(0, 10, 6) * MM))
    steps = [distance(a, b) for a, b in zip(motion.poses[:-1], motion.poses[1:], strict=True)]
    assert max(steps) == pytest.approx(2 * MM)
    assert motion.poses[-1] == pytest.approx(motion.poses[0])


def test_the_way_back_is_a_screw_motion():
    turned = pose(Rotation.from_euler("z", 40, degrees=True).as_matrix(), [0.01, 0.0, 0.0])
    poses = np.array([np.eye(4), turned])
    motion = CycleMotion.of_frames(np.array([0.0, 0.1]), poses, np.array([100.0, 300.0]))
    assert motion.load[[1, -1]] == pytest.approx([300.0, 100.0])
    angles = Rotation.from_matrix(motion.poses[1:, :3, :3]).as_euler("zyx", degrees=True)[:, 0]
    assert np.diff(angles) == pytest.approx(np.full(len(angles) - 1, -40 / (len(angles) - 1)))


def test_failed_frames_are_left_out_and_said_and_another_closing_is_refused():
    time, poses, load = frames(np.linspace(0, 8, 9) * MM)
    load[4] = np.nan
    assert "1 of 9 frames failed" in CycleMotion.of_frames(time, poses, load).notes[0]
    with pytest.raises(InputError, match="there-and-back"):
        CycleMotion.of_frames(time, poses, load, "there and back")


@pytest.mark.parametrize("count", [2, 3, 20, 101, 102, 173])
@pytest.mark.parametrize("most", [2, 3, 20, 25, 40])
def test_the_computed_frames_are_even_and_hold_both_ends(count, most):
    chosen = [k for part in chosen_frames(count, most) for k in part]
    assert len(chosen) == min(count, most)
    assert (chosen[0], chosen[-1]) == (0, count - 1)
    assert np.ptp(np.diff(chosen)) <= 1


@pytest.mark.parametrize("closing", CLOSINGS)
def test_fewer_frames_are_the_same_cycle(closing):
    """A wave of 101 frames, uneven from its ends: path and volume stay, whatever is computed."""
    time = np.linspace(0.0, 1.0, 101)
    places = 6 * MM * np.sin(5 * time) + 1 * MM * np.sin(31 * time)
    whole = frames(places)
    volumes = []
    for most in (101, 50, 25, 20, 9):
        part = [k for one in chosen_frames(101, most) for k in one]
        track = whole[:2] if most < 101 else None
        motion = CycleMotion.of_frames(*(v[part] for v in whole), closing, 0.01, track)
        volumes.append(worn(motion))
    assert volumes == pytest.approx([volumes[0]] * len(volumes), rel=1e-3)


def test_time_mean_pressure_follows_uneven_steps():
    """A tenth of the cycle at 1 MPa, then it falls to zero within no time."""
    pressure = np.array([[1e6], [1e6], [0.0], [0.0]])
    poses, up = frames(np.zeros(4))[1], np.array([[0.0, 1.0, 0.0]])
    seconds = np.array([0.1, 1e-9, 0.9])
    history = SlidingHistory.of_cycle(poses, pressure, np.zeros((1, 3)), up, 1, seconds)
    assert history.mean_pressure == pytest.approx([1e5], rel=1e-6)


def test_too_few_frames_are_flagged_and_enough_are_not():
    """A load that swings at each frame: half as many frames see the peaks alone."""

    def change(count, waves):
        time = np.linspace(0.0, 1.0, count)
        places = 10 * MM * time
        moments, poses, _ = frames(places)
        load = 1000.0 + 500.0 * np.cos(2 * np.pi * waves * time)
        motion = CycleMotion.of_frames(moments, poses, load, "as recorded")
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


def by_hand(rows):
    """Σ F s between the rows, both linear: N·mm."""
    rows = np.array(rows, float)
    return float((0.5 * (rows[1:, 1] + rows[:-1, 1]) * np.abs(np.diff(rows[:, 3]))).sum())


@pytest.mark.parametrize("rows", [TRIANGLE, SAWTOOTH, SPIKE, UNEVEN])
@pytest.mark.parametrize("count", [2, 7, 40])
def test_a_profile_keeps_its_own_rows(tmp_path, rows, count):
    found = read_profile(profile(tmp_path, rows), count)
    own = [int(np.flatnonzero(np.isclose(found.percent, row[0]))[0]) for row in rows]
    assert found.load[own] == pytest.approx([row[1] for row in rows])
    assert found.coordinates[own, 0] / MM == pytest.approx([row[3] for row in rows])
    assert np.diff(found.percent).max() <= 100 / (count - 1) * (1 + 1e-9)
    path = np.abs(np.diff(found.coordinates[:, 0])) / MM
    work = float((0.5 * (found.load[1:] + found.load[:-1]) * path).sum())
    assert work == pytest.approx(by_hand(rows), rel=1e-9)


def lens(radius, half, centre):
    """The lower cap of a sphere in mm, its lowest point at the centre."""
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
    """Two lenses of radius 60 on a block of 50 x 10 x 76: sliding is the translation."""
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
def test_a_profile_wears_what_archard_says_by_hand(tmp_path, lenses_scene, rows):
    """The triangle: 2e-7 mm³/(N m) · 1000 N · 20 mm · 10^6 = 4.000 mm³."""
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
    found = run.compute().as_dict()
    expected = 2e-7 * by_hand(rows) * 1e-3 * 1e6
    assert found["volume_mm3"] == pytest.approx(expected, rel=2e-3)
    low, high = found["volume_mm3_range"]
    assert low < found["volume_mm3"] < high
    assert found["frames_change"] < 0.02


def test_a_scene_says_how_its_cycle_closes_and_the_command_goes_first(tmp_path, capsys):
    scene = balls_scene(tmp_path / "scene")
    text = scene.read_text(encoding="utf-8").replace("there-and-back", "as recorded")
    scene.write_text(text, encoding="utf-8")
    quick = {"contact": "foundation", "resolution_mm": 6.0, "frames": 3}
    assert wear_setup(scene, **quick).motion.closing == "as recorded"
    assert wear_setup(scene, close="there-and-back", **quick).motion.passes == 2
    given = wear_setup(scene, overrides={"wear.close": "interpolate"}, **quick)
    assert given.motion.closing == "interpolate"
    assert main(["wear", str(scene), "--close", "open", "--out", str(tmp_path / "none")]) == 2
    assert "no way 'open' to close a cycle" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_a_profile_takes_no_closing(tmp_path):
    scene = balls_scene(tmp_path)
    with pytest.raises(InputError, match="a cycle already"):
        wear_setup(scene, simulator=profile(tmp_path, TRIANGLE), close="interpolate")
