"""Knee motion: angle orders, frames, cycles, mirrored left knees, refusals."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.frames import inverse, knee_pose, mirrored_pose, pose
from tkamb.io.recordings.motion import load_motion
from tkamb.io.recordings.recording_tables import MotionTable

TIME = np.linspace(0, 3, 101)
EYE = np.eye(4)


def bend(time=TIME):
    """Return a smooth bend (n, 6): ap, si, ml (m), axial rotation, adduction, flexion (rad)."""
    phase = 0.5 - 0.5 * np.cos(2 * np.pi * time / 3)
    return np.stack(
        [
            -0.006 * phase + 0.002,
            0.03 + 0.002 * phase,
            0.001 * np.sin(time),
            0.15 * phase,
            0.02 * np.sin(2 * time),
            0.1 + 1.8 * phase,
        ],
        axis=1,
    )


def write(path: Path, columns: dict) -> Path:
    rows = np.stack(list(columns.values()), axis=1)
    text = [",".join(columns), *(",".join(f"{v:.15g}" for v in row) for row in rows)]
    path.write_text("\n".join(text), encoding="utf-8")
    return path


def coordinate_columns(motion, time=TIME):
    deg = np.rad2deg(motion[:, 3:])
    return {
        "time": time,
        "ap": motion[:, 0] * 1e3,
        "si": motion[:, 1] * 1e3,
        "ml": motion[:, 2] * 1e3,
        "axial_rotation": deg[:, 0],
        "adduction": deg[:, 1],
        "flexion": deg[:, 2],
    }


def pose_columns(poses, sequence, time=TIME):
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler(sequence)
    names = [f"rotation_{k}" for k in (1, 2, 3)], [f"translation_{k}" for k in (1, 2, 3)]
    return {
        "time": time,
        **dict(zip(names[0], angles.T, strict=True)),
        **dict(zip(names[1], poses[:, :3, 3].T, strict=True)),
    }


def coordinates_table(file, **changes):
    keys = {"file": file, "angle_unit": "deg", "length_unit": "mm", "cutoff_Hz": "none"}
    return MotionTable(**(keys | changes))


def pose_table(file, sequence="XYZ", **changes):
    keys = {"interpretation": "pose", "sequence": sequence, "angle_unit": "rad"}
    return coordinates_table(file, **(keys | {"length_unit": "m"} | changes))


def test_coordinates_are_read_in_si_with_their_rates(tmp_path):
    table = coordinates_table(write(tmp_path / "m.csv", coordinate_columns(bend())))
    motion = load_motion(table, "right", EYE, EYE)
    np.testing.assert_allclose(motion.coordinates, bend(), atol=1e-14)
    np.testing.assert_allclose(motion.raw_coordinates, bend(), atol=1e-14)
    h = 1e-4
    rate = (bend(TIME + h) - bend(TIME - h)) / (2 * h)
    second = (bend(TIME + h) - 2 * bend(TIME) + bend(TIME - h)) / h**2
    np.testing.assert_allclose(motion.velocity[3:-3], rate[3:-3], atol=2e-7)
    np.testing.assert_allclose(motion.acceleration[3:-3], second[3:-3], atol=2e-5)
    assert motion.cycle_percent is None
    assert motion.patella is None


@pytest.mark.parametrize("sequence", ["XYZ", "zxy", "ZYX"])
def test_any_angle_order_and_mesh_axes_give_the_same_knee(tmp_path, sequence):
    """T_femur_in_insert = T_insert_mesh_in_insert P inverse(T_femoral_mesh_in_femur)."""
    rng = np.random.default_rng(0)
    insert_mesh, femoral_mesh = (
        pose(Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 0.01, 3))
        for _ in range(2)
    )
    recorded = inverse(insert_mesh) @ knee_pose(bend()) @ femoral_mesh
    file = write(tmp_path / "m.csv", pose_columns(recorded, sequence))
    motion = load_motion(pose_table(file, sequence), "right", insert_mesh, femoral_mesh)
    np.testing.assert_allclose(motion.coordinates, bend(), atol=1e-13)


def test_a_left_knee_gives_the_arrays_of_its_mirror_image(tmp_path):
    left = bend() * [1, 1, -1, 1, 1, 1]
    right_file = write(tmp_path / "r.csv", coordinate_columns(bend()))
    left_file = write(tmp_path / "l.csv", coordinate_columns(left))
    poses = write(tmp_path / "p.csv", pose_columns(mirrored_pose(knee_pose(bend())), "XYZ"))
    right = load_motion(coordinates_table(right_file), "right", EYE, EYE)
    for table in (coordinates_table(left_file), pose_table(poses)):
        result = load_motion(table, "left", EYE, EYE)
        for name, scale in (("coordinates", 1), ("velocity", 1), ("acceleration", 100)):
            np.testing.assert_allclose(
                getattr(result, name), getattr(right, name), atol=1e-12 * scale
            )


def test_patella_is_read_and_stays_sagittal_on_both_sides(tmp_path):
    columns = coordinate_columns(bend()) | {
        "patella_ap": 40 + TIME,
        "patella_si": 5 - TIME**2,
        "turn": np.rad2deg(0.3 * TIME),
    }
    file = write(tmp_path / "m.csv", columns)
    table = coordinates_table(file, columns={"patella_rotation": "turn"})
    for side in ("right", "left"):
        motion = load_motion(table, side, EYE, EYE)
        expected = np.stack([0.04 + TIME / 1e3, 0.005 - TIME**2 / 1e3, 0.3 * TIME], axis=1)
        np.testing.assert_allclose(motion.patella, expected, atol=1e-12)
        np.testing.assert_allclose(motion.patella_acceleration[:, 1], -2e-3, atol=1e-8)


def test_deviation_is_the_change_by_the_filter(tmp_path):
    rough = bend()
    rough[50, 0] += 2e-3
    rough[30, 3] += np.deg2rad(2)
    file = write(tmp_path / "m.csv", coordinate_columns(rough))
    motion = load_motion(coordinates_table(file, cutoff_Hz=3.0), "right", EYE, EYE)
    assert np.argmax(motion.deviation_translation) == 50
    assert np.argmax(motion.deviation_rotation) == 30
    assert 1e-3 < motion.deviation_translation.max() < 2e-3
    assert np.deg2rad(1) < motion.deviation_rotation.max() < np.deg2rad(2)
    assert np.median(motion.deviation_translation) < 1e-4


def test_resampling_keeps_the_ends(tmp_path):
    file = write(tmp_path / "m.csv", coordinate_columns(bend()))
    motion = load_motion(coordinates_table(file, frames=61), "right", EYE, EYE)
    np.testing.assert_allclose(motion.time, np.linspace(0, 3, 61))
    np.testing.assert_allclose(motion.coordinates, bend(motion.time), atol=1e-9)


def cycle(percent):
    wave = np.sin(2 * np.pi * percent / 100)
    return np.stack(
        [0.005 * wave, 0.03 + 0 * wave, 0 * wave, 0.1 * wave, 0 * wave, 0.5 + 0.4 * wave], 1
    )


@pytest.mark.parametrize("offset", [0.0, 30.0, -12.5])
def test_a_closed_cycle_gets_times_and_a_periodic_filter(tmp_path, offset):
    percent = np.linspace(0, 100, 101)
    file = write(tmp_path / "m.csv", coordinate_columns(cycle(percent), percent))
    table = coordinates_table(
        file, cutoff_Hz=6.0, cycle_s=(2.0, 3.5), cycle_offset_percent=offset, frames=76
    )
    motion = load_motion(table, "right", EYE, EYE)
    np.testing.assert_allclose(motion.time, np.linspace(2, 3.5, 76))
    np.testing.assert_allclose(motion.cycle_percent, offset + np.linspace(0, 100, 76))
    assert motion.closed_cycle
    np.testing.assert_allclose(motion.coordinates, cycle(motion.cycle_percent), atol=2e-6)
    omega = 2 * np.pi / 1.5
    expected = -(omega**2) * 0.4 * np.sin(2 * np.pi * motion.cycle_percent / 100)
    np.testing.assert_allclose(motion.acceleration[:, 5], expected, atol=2e-4)
    for values in (motion.coordinates, motion.velocity, motion.acceleration):
        np.testing.assert_allclose(values[0], values[-1], atol=1e-9)


def test_cycle_without_frames_keeps_the_recorded_samples(tmp_path):
    percent = np.linspace(0, 100, 51)
    file = write(tmp_path / "m.csv", coordinate_columns(cycle(percent), percent))
    for offset in (0.0, 30.0):
        table = coordinates_table(file, cycle_s=(2.0, 3.5), cycle_offset_percent=offset)
        motion = load_motion(table, "right", EYE, EYE)
        assert len(motion.time) == 51
        np.testing.assert_allclose(np.diff(motion.time), 0.03)
        np.testing.assert_allclose(motion.raw_coordinates, cycle(motion.cycle_percent), atol=1e-9)


def test_an_open_cycle_is_not_closed_and_accepts_no_offset(tmp_path):
    percent = np.linspace(0, 100, 101)
    drifting = cycle(percent) + percent[:, None] * [0, 0, 0, 0, 0, 0.005]
    file = write(tmp_path / "m.csv", coordinate_columns(drifting, percent))
    motion = load_motion(coordinates_table(file, cycle_s=(0.0, 1.5)), "right", EYE, EYE)
    assert not motion.closed_cycle
    with pytest.raises(InputError, match="not a closed cycle"):
        load_motion(
            coordinates_table(file, cycle_s=(0.0, 1.5), cycle_offset_percent=10), "right", EYE, EYE
        )


def refused(tmp_path, message, recorded=None, **changes):
    file = write(tmp_path / "m.csv", recorded or coordinate_columns(bend()))
    with pytest.raises(InputError, match=message) as caught:
        load_motion(coordinates_table(file, **changes), "right", EYE, EYE)
    assert "\n" not in str(caught.value)


def test_invalid_recordings_are_refused(tmp_path):
    good = coordinate_columns(bend())
    refused(tmp_path, "axial_rotation runs from .* deg, which no knee does", angle_unit="rad")
    refused(tmp_path, "unknown role 'flex'", columns={"flex": "flexion"})
    refused(tmp_path, "no column 'bend'; its header: time", columns={"flexion": "bend"})
    refused(tmp_path, "half the sampling rate", cutoff_Hz=20.0)
    refused(tmp_path, "shorter than one period", cutoff_Hz=0.2)
    refused(tmp_path, "missing or non-finite", good | {"si": np.full(101, np.nan)})
    refused(tmp_path, "does not rise", good | {"time": TIME[::-1]})
    refused(tmp_path, "not per cent", good | {"time": TIME * 100}, cycle_s=(0.0, 1.0))
    refused(tmp_path, "cycle_s does not rise", cycle_s=(1.0, 1.0))


def test_a_header_that_contradicts_the_scene_is_refused(tmp_path):
    columns = coordinate_columns(bend())
    rows = np.stack(list(columns.values()), axis=1)
    lines = ["inDegrees=yes", "endheader", "\t".join(columns)]
    lines += ["\t".join(f"{v:.9g}" for v in row) for row in rows]
    file = tmp_path / "m.mot"
    file.write_text("\n".join(lines), encoding="utf-8")
    assert load_motion(coordinates_table(file), "right", EYE, EYE).coordinates[0, 5] > 0
    with pytest.raises(InputError, match="is in degrees by its own header"):
        load_motion(coordinates_table(file, angle_unit="rad"), "right", EYE, EYE)


def test_a_recording_of_one_row_is_named(tmp_path):
    path = write(tmp_path / "a.csv", {k: v[:1] for k, v in coordinate_columns(bend()).items()})
    for changes in ({}, {"interval_s": (0.0, 1.0)}):
        with pytest.raises(InputError, match="has one row, at 0 s, which is no movement"):
            load_motion(coordinates_table(path, **changes), "right", EYE, EYE)
