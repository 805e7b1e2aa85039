"""Bodies and poses for the measurements of the lattice, in metres in the insert frame."""

from pathlib import Path

import numpy as np
import trimesh

from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.geometry.frames import knee_pose, pose
from tkamb.geometry.surface import Surface
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case

BEND = Path(__file__).parents[2] / "models" / "deep_knee_bend" / "scene.toml"
AXES = np.diag([-1.0, 1.0, -1.0])
"""Mesh axes of subjects DM and JW: x posterior, y superior, z medial."""


def two_condyles(varus=0.0, radius=22e-3, apart=11e-3, flex=1.0):
    """Return a femoral component of two ellipsoids over an insert with two dishes, and a pose."""
    ball = trimesh.creation.icosphere(subdivisions=6, radius=radius)
    parts = [ball.copy().apply_translation((0, 0, side * apart)) for side in (-1, 1)]
    femoral = trimesh.util.concatenate(parts)
    return (
        Surface(np.array(femoral.vertices), np.array(femoral.faces, np.int64), "condyles"),
        _dished(apart, 34e-3, flex),
        knee_pose([0, 0, 0, 0, np.radians(varus), 0]),
    )


def _dished(apart, radius, flex, width=30e-3, depth=46e-3, height=10e-3, cells=75):
    x, z = np.linspace(-width / 2, width / 2, cells + 1), np.linspace(-depth / 2, depth / 2, 116)
    gx, gz = np.meshgrid(x, z, indexing="ij")
    away = np.minimum(np.hypot(gx, gz - apart), np.hypot(gx, gz + apart))
    top = height - 2e-3 + np.minimum(flex * away**2 / (2 * radius), 2e-3)
    upper = np.stack([gx, top, gz], axis=-1).reshape(-1, 3)
    number = np.arange(gx.size).reshape(gx.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    quads = np.stack([a, d, c, b], axis=-1).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    rim = np.concatenate([number[:, 0], number[-1, 1:], number[-2::-1, -1], number[0, -2:0:-1]])
    n, after = gx.size, np.roll(rim, -1)
    walls = [np.stack([rim, after + n, rim + n], 1), np.stack([rim, after, after + n], 1)]
    mesh = trimesh.Trimesh(
        np.concatenate([upper, upper * [1, 0, 1]]),
        np.concatenate([faces, faces[:, ::-1] + n, *walls]),
    )
    mesh.fix_normals()
    return Surface(np.array(mesh.vertices), np.array(mesh.faces, np.int64), "dished insert")


def subject(data: Path, name: str):
    """Return the femoral component, the insert and its origin in the mesh (m)."""
    folder = data / name / "geometry"
    femoral, insert = (
        trimesh.load(folder / f"{part}.stl", force="mesh", process=True)
        for part in ("femoral_component", "tibial_insert")
    )
    vertices = np.array(insert.vertices) @ AXES
    bottom = vertices[vertices[:, 1] < vertices[:, 1].min() + 1e-5]
    origin = (bottom.min(axis=0) + bottom.max(axis=0)) / 2
    return (
        Surface(np.array(femoral.vertices) @ AXES, np.array(femoral.faces, np.int64), "femoral"),
        Surface(vertices - origin, np.array(insert.faces, np.int64), "insert"),
        origin,
    )


def dm_stance(data: Path, percent=30):
    """Return DM's bodies and the recorded pose at a per cent of the gait cycle (Rx Ry Rz)."""
    from scipy.spatial.transform import Rotation

    femoral, insert, origin = subject(data, "dm")
    lines = (data / "dm" / "fluoroscopy" / "gait_cycle.sto").read_text().split("endheader")[1]
    table = np.array([line.split() for line in lines.strip().splitlines()[1:]], float)
    row = table[np.argmin(np.abs(table[:, 0] - percent))]
    rotation = AXES @ Rotation.from_euler("XYZ", row[4:7]).as_matrix() @ AXES
    return femoral, insert, pose(rotation, AXES @ row[1:4] - origin)


def jw_centred(data: Path):
    """Return JW's bodies aligned at 0 deg, lowest points of the condyles over the dishes."""
    femoral, insert, _ = subject(data, "jw")
    low = femoral.vertices[femoral.vertices[:, 1] < femoral.vertices[:, 1].min() + 0.2e-3]
    inner = np.abs(insert.vertices[:, 2]) < 30e-3
    dish = insert.vertices[inner & (np.abs(insert.vertices[:, 1] - 6e-3) < 0.1e-3)]
    shift = np.array([(dish.max(0) + dish.min(0))[0] / 2 - (low.max(0) + low.min(0))[0] / 2, 0, 0])
    return femoral, insert, pose(np.eye(3), shift)


def shipped():
    """Return the shipped knee's bodies and its recorded pose in the middle of the bend."""
    case = load_case(load_scene(BEND))
    middle = len(case.motion.time) // 2
    return case.femoral, case.insert, knee_pose(case.motion.coordinates[middle])


def bodies(case: str, data: Path | None):
    """Return the femoral component, the insert and the pose of a named case."""
    if case == "two-condyles":
        return two_condyles()
    if case == "two-condyles-varus":
        return two_condyles(0.3)
    if case == "shipped":
        return shipped()
    if data is None:
        raise SystemExit(f"case {case} needs --data")
    return jw_centred(data) if case == "jw" else dm_stance(data, int(case.removeprefix("dm")))


def contact_pair(case: str, data: Path | None, material_name: str):
    """Return the pair and the pose of a named case."""
    femoral, insert, at = bodies(case, data)
    return ContactPair(femoral, insert, material(material_name)), at


def nearby(at, step=1.0):
    """Return a neighbouring pose: 0.3 mm posterior, 1 deg more flexion, 0.3 deg axial rotation."""
    moved = knee_pose(step * np.array([-0.3e-3, 0, 0, np.radians(0.3), 0, np.radians(1.0)]))
    turned = at.copy()
    turned[:3, :3] = moved[:3, :3] @ at[:3, :3]
    turned[0, 3] += moved[0, 3]
    return turned
