"""The shipped right knee written as a left one: each file reflected in the sagittal plane."""

import csv
import re

import numpy as np
import trimesh

from scenes import MODEL, write_scene

MIRROR = np.diag([1.0, 1.0, -1.0])


def write_mirrored_patient(folder):
    """Write the mirrored patient into `folder`; return the path of its scene."""
    import tomllib

    scene = tomllib.loads((MODEL / "scene.toml").read_text(encoding="utf-8"))
    changes = {"patient__side": "left"}
    for table in ("quadriceps", "patellar_ligament"):
        for end in set(scene[table]) & {"origin", "insertion", "proximal", "distal"}:
            changes[f"{table}__{end}__point_mm"] = _flip(scene[table][end]["point_mm"])
    for bundle in scene["ligament"]:
        for end in ("proximal", "distal"):
            bundle[end]["point_mm"] = _flip(bundle[end]["point_mm"])
    changes["ligament"] = scene["ligament"]
    path = write_scene(folder, **changes)
    for name in ("femoral_component", "insert", "patellar_button"):
        mirror_mesh(path.parent / f"{name}.stl")
    _negate_columns(path.parent / "motion.csv", ("ml_mm",))
    _negate_columns(path.parent / "ground_reaction.csv", ("force_z_N", "point_z_mm"))
    urdf = path.parent / "patient.urdf"
    urdf.write_text(_mirrored_urdf(urdf.read_text(encoding="utf-8")), encoding="utf-8")
    return path


def _flip(point):
    return [point[0], point[1], -point[2]]


def mirror_mesh(path):
    """Reflect the mesh of a file in the sagittal plane."""
    mesh = trimesh.load(path)
    trimesh.Trimesh(mesh.vertices @ MIRROR, mesh.faces[:, ::-1], process=False).export(path)


def _negate_columns(path, names):
    rows = list(csv.reader(path.read_text(encoding="utf-8").splitlines()))
    columns = [rows[0].index(name) for name in names]
    for row in rows[1:]:
        for k in columns:
            row[k] = repr(-float(row[k]))
    path.write_text("\n".join(",".join(row) for row in rows) + "\n", encoding="utf-8")


def _mirrored_urdf(text):
    """Reflect origins (z, roll, pitch change sign), axes of rotation and products of inertia."""
    text = re.sub(
        r'xyz="(\S+) (\S+) (\S+)"', lambda m: f'xyz="{m[1]} {m[2]} {-float(m[3])!r}"', text
    )
    text = re.sub(
        r'rpy="(\S+) (\S+) (\S+)"',
        lambda m: f'rpy="{-float(m[1])!r} {-float(m[2])!r} {m[3]}"',
        text,
    )
    text = re.sub(r'(i[xy]z)="(\S+?)"', lambda m: f'{m[1]}="{-float(m[2])!r}"', text)

    def axis(match):
        x, y, z = (float(part) for part in match[2].split())
        z = -z  # undo the first substitution, which has negated z of every axis
        if match[1] in ("revolute", "continuous"):
            x, y = -x, -y
        return match[0].replace(match[2], f"{x + 0.0!r} {y + 0.0!r} {z + 0.0!r}")

    pattern = r'type="(revolute|continuous|prismatic)".*?<axis xyz="([^"]+)"'
    return re.sub(pattern, axis, text, flags=re.DOTALL)
