"""Subject DM, written as a left knee, gives the same results.

All files (meshes, poses, markers, plates, URDF) and the points of the scene are reflected in the
sagittal plane. Positions and forces change the sign of z. Rotations and torques are pseudo-vectors:
they change the signs of x and y. The files are written to a temporary folder.
"""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from mirrored_patient import MIRROR, _flip, _mirrored_urdf
from raw_files import read_stl
from scenes import as_toml
from tkamb import load_scene, simulate

MODEL = Path(__file__).parents[1] / "models" / "dm"
DATA = Path(__file__).parents[2] / "shared" / "data" / "dm"
OVERRIDES = {
    "motion.frames": 11,
    "motion.cutoff_Hz": 3.0,
    "ground_reaction.cutoff_Hz": 3.0,
    "contact.model": "foundation",
    "contact.resolution_mm": 2.0,
}
FRAMES = slice(1, 8, 3)
TIMES = ("body_seconds", "query_seconds", "contact_seconds", "iterations")

needs_dm = pytest.mark.skipif(
    not (DATA / "DM.osim").is_file(), reason="subject DM's files (../shared/data/dm) are absent"
)


@pytest.mark.slow
@needs_dm
def test_mirrored_dm_gives_the_same_results(tmp_path):
    """All columns agree to 0.1 % of their largest value, in stance and swing."""
    right = simulate(load_scene(MODEL / "scene.toml", OVERRIDES), frames=FRAMES)
    left = simulate(load_scene(write_mirrored_dm(tmp_path), OVERRIDES), frames=FRAMES)
    assert left["status"] == right["status"]
    assert np.isfinite(right["force_total_N"]).any()
    names = [n for n in right.columns if n not in (*TIMES, "status")]
    assert set(right.columns) == set(left.columns)
    differences = {}
    for name in names:
        original, mirrored = right[name], left[name]
        assert np.array_equal(np.isnan(original), np.isnan(mirrored)), name
        size = np.nanmax(np.abs(original), initial=0.0)
        worst = np.nanmax(np.abs(original - mirrored), initial=0.0)
        if worst > 1e-3 * size + 1e-6:
            differences[name] = (worst, size)
    assert not differences


def test_a_moment_is_reflected_as_a_pseudo_vector():
    """A moment is the cross product of two reflected vectors."""
    point, force = np.array([0.1, -0.4, 0.03]), np.array([20.0, 700.0, -30.0])
    reflected = np.cross(MIRROR @ point, MIRROR @ force)
    assert np.allclose(reflected, -MIRROR @ np.cross(point, force))


def write_mirrored_dm(folder):
    """Write subject DM as a left knee into `folder`; return the path of the scene."""
    scene = tomllib.loads((MODEL / "scene.toml").read_text(encoding="utf-8"))
    scene["patient"]["side"] = "left"
    urdf = (MODEL / "patient.urdf").read_text(encoding="utf-8")
    (folder / "patient.urdf").write_text(_mirrored_urdf(urdf), encoding="utf-8")
    for table in (*scene["implant"].values(), scene["quadriceps"]["bone"]):
        source = MODEL / table["mesh"]
        table["mesh"] = source.name
        _write_stl(folder / source.name, read_stl(source)[:, ::-1] @ MIRROR)
    columns = scene["motion"]["columns"]
    negated = [columns[role] for role in ("rotation_1", "rotation_2", "translation_3")]
    _negate(scene["motion"], folder, negated)
    columns = scene["ground_reaction"]["columns"]
    negated = [columns[role] for role in ("force_3", "point_3", "moment_1", "moment_2")]
    _negate(scene["ground_reaction"], folder, negated)
    _mirror_markers(scene["tibia"], folder)
    _mirror_points(scene)
    path = folder / "scene.toml"
    path.write_text(as_toml(scene), encoding="utf-8")
    return path


def _mirror_points(table):
    """Reflect every point of a table in place: values of three numbers under keys `..._mm`."""
    for key, value in table.items():
        if isinstance(value, dict):
            _mirror_points(value)
        elif key.endswith("_mm") and isinstance(value, list) and len(value) == 3:
            table[key] = _flip(value)
        elif isinstance(value, list):
            for item in value:
                if isinstance(item, dict):
                    _mirror_points(item)
    if "markers_mm" in table:
        markers = table["markers_mm"].items()
        table["markers_mm"] = {name: _flip(point) for name, point in markers}


def _negate(table, folder, names):
    """Write the .sto file of a table with some columns negated."""
    source = MODEL / table["file"]
    table["file"] = source.name
    head, body = source.read_text(encoding="utf-8").split("endheader\n", 1)
    rows = [line.split("\t") for line in body.splitlines()]
    columns = [rows[0].index(name) for name in names]
    for row in rows[1:]:
        for k in columns:
            row[k] = _negated(row[k])
    text = head + "endheader\n" + "\n".join("\t".join(row) for row in rows) + "\n"
    (folder / source.name).write_text(text, encoding="utf-8")


def _mirror_markers(table, folder):
    source = MODEL / table["file"]
    table["file"] = source.name
    lines = source.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines[5:], start=5):
        cells = line.split("\t")
        cells[4::3] = [_negated(cell) for cell in cells[4::3]]
        lines[number] = "\t".join(cells)
    (folder / source.name).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _negated(cell):
    """Return the text of a number with the opposite sign; gaps stay unchanged."""
    cell = cell.strip()
    if not cell or "nan" in cell:
        return cell
    return cell[1:] if cell.startswith("-") else f"-{cell}"


def _write_stl(path, corners):
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    rows = np.zeros(len(corners), kind)
    rows["corners"] = corners
    path.write_bytes(bytes(80) + np.uint32(len(rows)).tobytes() + rows.tobytes())
