"""The shank in the laboratory: sagittal lean, poses, markers, joint centres, left sides."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.frames import MIRROR, mirrored_pose, pose, transform
from tkamb.io.recordings.markers import fit_rigid
from tkamb.io.recordings.recording_tables import JointCentreTable, TibiaTable
from tkamb.io.recordings.tibia import load_tibia

STAMPS = np.arange(241) / 120
AT = np.linspace(0.5, 1.5, 21)
MARKERS = {
    "upper": (40.0, 300.0, 30.0),
    "lower": (-10.0, 90.0, 45.0),
    "front": (35.0, 200.0, -15.0),
    "malleolus": (-5.0, 5.0, 40.0),
}


def shank(t):
    """Return the pose_tibia_in_laboratory (n, 4, 4) of a shank in swing and gait."""
    angles = np.stack([0.05 * np.sin(2 * t), 0.2 * t, -0.4 + 0.6 * np.sin(3 * t)], axis=-1)
    place = np.stack([1.2 * t, 0.1 + 0.02 * np.sin(4 * t), 0.1 * np.cos(t)], axis=-1)
    return pose(Rotation.from_euler("XYZ", angles).as_matrix(), place)


def write_trc(path, points, names, stamps=STAMPS):
    """Write points (n, m, 3) in mm as a .trc file."""
    cells = points.reshape(len(points), -1)
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
        f"120\t120\t{len(stamps)}\t{len(names)}\tmm",
        "Frame#\tTime\t" + "\t\t\t".join(names),
        "",
    ]
    for k, row in enumerate(cells):
        body = "\t".join("-nan(ind)" if np.isnan(v) else f"{v:.9f}" for v in row)
        lines.append(f"{k + 1}\t{stamps[k]:.3f}\t{body}")
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def marker_file(path, poses, markers=MARKERS):
    reference = np.array(list(markers.values())) * 1e-3
    points = transform(poses, np.broadcast_to(reference, (len(poses), *reference.shape)))
    return write_trc(path, points * 1e3, list(markers))


def marker_table(file, **changes):
    return TibiaTable(**({"kind": "markers", "file": file, "markers_mm": MARKERS} | changes))


def test_markers_give_pose_and_rates(tmp_path):
    file = marker_file(tmp_path / "s.trc", shank(STAMPS))
    tibia = load_tibia(marker_table(file), AT, "right", "none")
    np.testing.assert_allclose(tibia.pose, shank(AT), atol=1e-8)
    assert tibia.residual.max() < 1e-8
    h = 1e-4
    turn = np.swapaxes(shank(AT)[:, :3, :3], 1, 2)
    speed = (shank(AT + h)[:, :3, 3] - shank(AT - h)[:, :3, 3]) / (2 * h)
    np.testing.assert_allclose(
        tibia.velocity[:, :3], np.einsum("fij,fj->fi", turn, speed), atol=1e-5
    )
    step = turn @ shank(AT + h)[:, :3, :3]
    spin = Rotation.from_matrix(step).as_rotvec() / h
    np.testing.assert_allclose(tibia.velocity[:, 3:], spin, atol=2e-3)


def test_laboratory_axes_turn_a_walk_towards_minus_x(tmp_path):
    backwards = pose(np.diag([-1.0, 1.0, -1.0]), np.zeros(3)) @ shank(STAMPS)
    file = marker_file(tmp_path / "s.trc", backwards)
    tibia = load_tibia(marker_table(file, laboratory_axes="-x,+y,-z"), AT, "right", "none")
    np.testing.assert_allclose(tibia.pose, shank(AT), atol=1e-8)
    assert tibia.pose[-1, 0, 3] > tibia.pose[0, 0, 3]


def test_residual_is_the_noise_of_the_markers(tmp_path):
    rng = np.random.default_rng(0)
    reference = np.array(list(MARKERS.values())) * 1e-3
    points = transform(shank(STAMPS), np.broadcast_to(reference, (241, 4, 3)))
    noisy = points + rng.normal(0, 1e-3, points.shape)
    _, residual = fit_rigid(noisy, reference)
    # 6 of 12 coordinates are fitted, so half of the variance remains
    assert np.sqrt(np.mean(residual**2)) == pytest.approx(np.sqrt(3 / 2) * 1e-3, rel=0.05)


def test_the_fit_is_never_a_reflection():
    reference = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.2, 0]])
    turn = Rotation.random(20, random_state=1).as_matrix()
    poses, residual = fit_rigid(np.einsum("nij,mj->nmi", turn, reference), reference)
    np.testing.assert_allclose(poses[:, :3, :3], turn, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1, atol=1e-12)
    assert residual.max() < 1e-12


def test_the_ankle_centre_replaces_a_missing_marker(tmp_path):
    """Two shank markers and the ankle centre of the foot determine the shank's pose."""
    foot = {"heel": (-40.0, -60.0, 0.0), "toe": (180.0, -50.0, 10.0), "mid": (80.0, 20.0, 30.0)}
    ankle_in_foot = np.array([10.0, 30.0, -5.0])
    flex = Rotation.from_euler("ZX", np.stack([np.sin(5 * STAMPS), 0.2 * STAMPS], 1)).as_matrix()
    turned = shank(STAMPS) @ pose(flex, np.zeros(3)) @ pose(np.eye(3), -ankle_in_foot * 1e-3)
    shank_markers = {name: MARKERS[name] for name in ("lower", "front")}
    points = [
        transform(poses, np.broadcast_to(np.array(list(m.values())) * 1e-3, (241, len(m), 3)))
        for poses, m in ((shank(STAMPS), shank_markers), (turned, foot))
    ]
    file = write_trc(
        tmp_path / "s.trc", np.concatenate(points, axis=1) * 1e3, [*shank_markers, *foot]
    )
    ankle = JointCentreTable(
        name="ankle", markers_mm=foot, centre_mm=tuple(ankle_in_foot), tibia_mm=(0, 0, 0)
    )
    table = marker_table(file, markers_mm=shank_markers, joint_centre=(ankle,))
    tibia = load_tibia(table, AT, "right", "none")
    np.testing.assert_allclose(tibia.pose, shank(AT), atol=1e-8)
    with pytest.raises(InputError, match="markers of the tibia fix no orientation"):
        load_tibia(marker_table(file, markers_mm=shank_markers), AT, "right", "none")


def test_columns_of_poses_are_read(tmp_path):
    poses = shank(STAMPS)
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZXY", degrees=True)
    names = ["time", *(f"{w}_{k}" for w in ("rotation", "translation") for k in (1, 2, 3))]
    rows = np.column_stack([STAMPS, angles, poses[:, :3, 3] * 1e3])
    lines = [",".join(names), *(",".join(f"{v:.15g}" for v in row) for row in rows)]
    file = tmp_path / "p.csv"
    file.write_text("\n".join(lines), encoding="utf-8")
    table = TibiaTable(kind="pose", file=file, sequence="ZXY", length_unit="mm")
    tibia = load_tibia(table, AT, "right", "none")
    np.testing.assert_allclose(tibia.pose, shank(AT), atol=1e-8)
    assert tibia.residual is None


def lean_file(path):
    rows = [f"{t:.9f},{np.rad2deg(0.5 * np.sin(2 * t)):.15g}" for t in STAMPS]
    path.write_text("\n".join(["time,angle", *rows]), encoding="utf-8")
    return path


def test_sagittal_lean_is_forward_about_a_fixed_ankle(tmp_path):
    table = TibiaTable(kind="sagittal", file=lean_file(tmp_path / "l.csv"), ankle_mm=(10, 80, 90))
    tibia = load_tibia(table, AT, "right", "none")
    lean = 0.5 * np.sin(2 * AT)
    knee = transform(tibia.pose, np.array([0, 0.4, 0]))
    np.testing.assert_allclose(knee[:, 0], 0.01 + 0.4 * np.sin(lean), atol=1e-8)
    np.testing.assert_allclose(tibia.pose[:, :3, 3], np.tile([0.01, 0.08, 0.09], (21, 1)))
    np.testing.assert_allclose(tibia.velocity[:, 5], -np.cos(2 * AT), atol=1e-6)
    np.testing.assert_allclose(tibia.acceleration[:, 5], 2 * np.sin(2 * AT), atol=1e-4)
    assert not tibia.velocity[:, :5].any()


def test_a_left_shank_gives_the_arrays_of_its_mirror_image(tmp_path):
    mirrored = {name: tuple(MIRROR @ place) for name, place in MARKERS.items()}
    right_file = marker_file(tmp_path / "r.trc", shank(STAMPS))
    left_file = marker_file(tmp_path / "l.trc", mirrored_pose(shank(STAMPS)), mirrored)
    right = load_tibia(marker_table(right_file), AT, "right", 6.0)
    left = load_tibia(marker_table(left_file, markers_mm=mirrored), AT, "left", 6.0)
    np.testing.assert_allclose(left.pose, right.pose, atol=1e-12)
    np.testing.assert_allclose(left.velocity, right.velocity, atol=1e-11)
    np.testing.assert_allclose(left.acceleration, right.acceleration, atol=1e-9)
    sagittal = TibiaTable(
        kind="sagittal", file=lean_file(tmp_path / "s.csv"), ankle_mm=(10, 80, -90)
    )
    leaning = load_tibia(sagittal, AT, "left", "none")
    np.testing.assert_allclose(leaning.pose[:, :3, 3], np.tile([0.01, 0.08, 0.09], (21, 1)))


def test_a_gap_outside_the_interval_has_no_influence(tmp_path):
    reference = np.array(list(MARKERS.values()))
    points = transform(shank(STAMPS), np.broadcast_to(reference * 1e-3, (241, 4, 3))) * 1e3
    points[20, 1] = np.nan
    points[200] = 0.0
    file = write_trc(tmp_path / "s.trc", points, list(MARKERS))
    tibia = load_tibia(marker_table(file), AT, "right", "none")
    np.testing.assert_allclose(tibia.pose, shank(AT), atol=1e-8)
    with pytest.raises(InputError, match=r"shank marker 'lower' is missing at 0\.16\d+ s"):
        load_tibia(marker_table(file), AT - 0.4, "right", "none")
    with pytest.raises(InputError, match=r"shank marker 'upper' is missing at 1\.66\d+ s"):
        load_tibia(marker_table(file), AT + 0.3, "right", "none")


def test_contradictory_marker_tables_are_refused(tmp_path):
    file = marker_file(tmp_path / "s.trc", shank(STAMPS))
    with pytest.raises(InputError, match="no column 'uper_x'; did you mean upper_x"):
        load_tibia(
            marker_table(file, markers_mm={**MARKERS, "uper": (0, 0, 0)}), AT, "right", "none"
        )
    stretched = {name: tuple(np.array(p) * 3) for name, p in MARKERS.items()}
    with pytest.raises(InputError, match="shank markers have a residual of"):
        load_tibia(marker_table(file, markers_mm=stretched), AT, "right", "none")
    with pytest.raises(InputError, match=r"covers -?0\.0000 to 2\.0000 s, but"):
        load_tibia(marker_table(file), AT + 1, "right", "none")
    with pytest.raises(InputError, match="header, but the scene says m"):
        load_tibia(marker_table(file, length_unit="m"), AT, "right", "none")
    with pytest.raises(InputError, match="left-handed"):
        load_tibia(marker_table(file, laboratory_axes="+x,+y,-z"), AT, "right", "none")
