"""Random changes of scenes, motions and meshes give a result or a one-line error message."""

import shutil
import string
import tempfile
import tomllib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scenes import MODEL, as_toml, fast_scene
from tkamb.cli import main
from tkamb.errors import TkambError
from tkamb.io.scene import load_scene

GENTLE = settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
COARSE = ("--contact", "foundation", "--resolution", "3")
SCENE = tomllib.loads(fast_scene().read_text(encoding="utf-8"))
NUMBERS = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False), st.integers(-(10**6), 10**6), st.just(0.0)
)
VALUES = st.recursive(
    st.one_of(NUMBERS, st.booleans(), st.text(string.printable, max_size=12)),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.text(string.ascii_lowercase, min_size=1, max_size=8), inner, max_size=3
        )
    ),
    max_leaves=6,
)


def paths_of(content, above=()):
    """Return the path to every key of nested tables."""
    paths = []
    for key, value in content.items():
        paths.append((*above, key))
        if isinstance(value, dict):
            paths += paths_of(value, (*above, key))
    return paths


PATHS = sorted(paths_of(SCENE))


def changed(content, path, value):
    """Return nested tables with one key changed. The value None removes the key."""
    content = dict(content)
    if len(path) > 1:
        content[path[0]] = changed(content[path[0]], path[1:], value)
    elif value is None:
        content.pop(path[0])
    else:
        content[path[0]] = value
    return content


def run_cleanly(folder, capsys, *more):
    """Run three frames, check the printed messages, and return the exit status."""
    out = folder / "out"
    status = main(
        ["run", str(folder / "scene.toml"), "--out", str(out), "--frames", "0:101:50", *more]
    )
    output = capsys.readouterr().err
    assert status in (0, 1, 2)
    assert "Traceback" not in output
    if status == 2:
        assert len([line for line in output.splitlines() if line.startswith("tkamb: ")]) == 1
        assert not (out / "results.csv").exists()
    return status


def refusal(file):
    """Return the error message of a scene file, or "" if the file can be read."""
    try:
        load_scene(file)
    except TkambError as error:
        return str(error) or "nothing said\n"
    return ""


@settings(GENTLE, max_examples=75)
@given(st.sampled_from(PATHS), st.none() | VALUES)
def test_a_scene_with_a_random_key_is_read_or_refused(path, value):
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "scene.toml"
        try:
            file.write_text(as_toml(changed(SCENE, path, value)), encoding="utf-8")
            tomllib.loads(file.read_text(encoding="utf-8"))
        except (tomllib.TOMLDecodeError, UnicodeError):
            return
        output = refusal(file)
        assert "\n" not in output


@settings(GENTLE, max_examples=60)
@given(st.binary(max_size=400) | st.text(string.printable, max_size=400))
def test_any_text_is_read_or_refused_as_a_scene(content):
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "scene.toml"
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(TkambError) as caught:
            load_scene(file)
        assert "\n" not in str(caught.value)


@settings(GENTLE, max_examples=6)
@given(st.sampled_from(PATHS), st.none() | NUMBERS)
def test_a_run_of_a_scene_with_a_random_number(capsys, path, value):
    with tempfile.TemporaryDirectory() as name:
        shutil.copytree(MODEL, name, dirs_exist_ok=True)
        file = Path(name) / "scene.toml"
        file.write_text(as_toml(changed(SCENE, path, value)), encoding="utf-8")
        run_cleanly(Path(name), capsys, *COARSE)


CELLS = st.sampled_from(["", "nan", "inf", "-1e300", "1e9", "0", "abc", "1,2", '"', "\x00", "é"])


@settings(GENTLE, max_examples=8)
@given(
    st.sampled_from(["motion.csv", "tibia.csv", "ground_reaction.csv"]),
    st.integers(0, 101),
    st.integers(0, 9),
    CELLS,
)
def test_a_run_with_a_random_cell_in_its_tables(capsys, name, row, column, cell):
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        shutil.copytree(MODEL, folder, dirs_exist_ok=True)
        lines = (folder / name).read_text().splitlines()
        cells = lines[min(row, len(lines) - 1)].split(",")
        cells[column % len(cells)] = cell
        lines[min(row, len(lines) - 1)] = ",".join(cells)
        (folder / name).write_text("\n".join(lines) + "\n")
        run_cleanly(folder, capsys, *COARSE)


@settings(GENTLE, max_examples=4)
@given(
    st.sampled_from(["femoral_component.stl", "insert.stl"]),
    st.sampled_from(["cut", "noise", "scale", "drop", "bytes", "turn"]),
    st.integers(0, 2**31),
)
def test_a_press_of_random_meshes(capsys, name, how, seed):
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        shutil.copytree(MODEL, folder, dirs_exist_ok=True)
        damage(folder / name, how, np.random.default_rng(seed))
        files = [str(folder / part) for part in ("femoral_component.stl", "insert.stl")]
        status = main(["press", *files, "--load", "800", *COARSE, "--json"])
        output = capsys.readouterr().err
        assert status in (0, 1, 2)
        assert "Traceback" not in output


def damage(path, how, rng):
    """Spoil a mesh file in one way."""
    content = path.read_bytes()
    if how == "cut":
        path.write_bytes(content[: rng.integers(0, len(content))])
        return
    if how == "bytes":
        spoilt = np.frombuffer(content, np.uint8).copy()
        spoilt[rng.integers(0, len(spoilt), 50)] = rng.integers(0, 256, 50)
        path.write_bytes(spoilt.tobytes())
        return
    mesh = trimesh.load_mesh(path)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    if how == "noise":
        vertices += rng.normal(0, 10.0 ** rng.uniform(-3, 1), vertices.shape)
    elif how == "scale":
        vertices *= 10.0 ** rng.uniform(-4, 4)
    elif how == "drop":
        faces = faces[rng.random(len(faces)) < rng.random()]
    else:
        vertices = vertices @ trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    spoilt = trimesh.Trimesh(vertices, faces, process=False)
    path.write_bytes(trimesh.exchange.stl.export_stl(spoilt))


@settings(GENTLE, max_examples=40)
@given(
    st.floats(-1e9, 1e9) | st.sampled_from([np.nan, np.inf]),
    st.lists(st.floats(-1e4, 1e4), min_size=6, max_size=6),
    st.floats(-2, 50),
)
def test_a_press_with_random_numbers(capsys, load, pose, resolution):
    files = [str(MODEL / part) for part in ("femoral_component.stl", "insert.stl")]
    resolution = max(resolution, 2.5) if resolution > 0 else resolution
    given_pose = [repr(float(v)) for v in pose]
    options = ["--load", repr(load), "--resolution", repr(resolution), "--pose", *given_pose]
    try:
        status = main(["press", *files, *options])
    except SystemExit as refused:
        status = refused.code
    output = capsys.readouterr().err
    assert status in (0, 1, 2)
    assert "Traceback" not in output
