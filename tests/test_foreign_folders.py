"""A forged folder of results is refused in one line, and no file outside it is read."""

import hashlib
import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from scenes import MODEL
from tkamb.cli import main

SECRET = "somebody's own file, which no output may hold"


def _rehash(out: Path) -> None:
    """Put the SHA-256 of the changed files into summary.json, as a forger would."""
    path = out / "summary.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    if isinstance(content.get("files"), dict):
        for name in ("results.csv", "contact.h5"):
            if (out / name).exists():
                content["files"][name] = hashlib.sha256((out / name).read_bytes()).hexdigest()
    content.pop("summary_sha256", None)
    text = json.dumps(content, sort_keys=True)
    content["summary_sha256"] = hashlib.sha256(text.encode()).hexdigest()
    path.write_text(json.dumps(content), encoding="utf-8")


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    out = tmp_path_factory.mktemp("foreign") / "results"
    options = ["--contact", "foundation", "--resolution", "6", "--frames", "0:1"]
    assert main(["run", str(MODEL / "scene.toml"), *options, "--out", str(out)]) == 0
    return out


@pytest.fixture
def copy(results, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(results, out)
    return out


def refused(capfd, *arguments):
    capfd.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    message = capfd.readouterr().err
    assert message.count("\n") == 1 and "unexpected error" not in message
    return message


@pytest.mark.parametrize("link_type", ["external", "link", "soft", "virtual"])
def test_an_array_in_another_file_is_not_followed(copy, tmp_path, capfd, link_type):
    secret = tmp_path / "secret.txt"
    secret.write_text(SECRET * 10_000)
    with h5py.File(copy / "contact.h5", "a") as file:
        shape = file["points_m"].shape
        del file["points_m"]
        if link_type == "external":
            size = 8 * int(np.prod(shape))
            file.create_dataset("points_m", shape, "f8", external=[(str(secret), 0, size)])
        elif link_type == "link":
            file["points_m"] = h5py.ExternalLink(str(secret), "/x")
        elif link_type == "soft":
            file["points_m"] = h5py.SoftLink("/gap_m")
        else:
            layout = h5py.VirtualLayout(shape, "f8")
            layout[:] = h5py.VirtualSource(str(secret), "x", shape=shape)
            file.create_virtual_dataset("points_m", layout)
    _rehash(copy)
    message = refused(capfd, "export", copy, "--vtp", "--out", tmp_path / "made")
    assert "points_m" in message and ("link" in message or "another file" in message)
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("body_mass_kg", "heavy"),
        ("contact", ["foundation"]),
    ],
)
def test_a_summary_of_another_kind_ends_a_command_in_one_line(copy, capfd, key, value):
    path = copy / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    _rehash(copy)
    message = refused(capfd, "report", copy)
    assert str(copy) in message and "run the scene again" in message


@pytest.mark.parametrize("key", ["friction", "resolution_mm"])
def test_a_negative_contact_value_in_the_summary_is_refused_by_wear(copy, tmp_path, capfd, key):
    path = copy / "summary.json"
    content = json.loads(path.read_text())
    content["contact"] |= {key: -1}
    path.write_text(json.dumps(content))
    _rehash(copy)
    message = refused(
        capfd, "wear", copy, "--cycles", 1, "--updates", 1, "--out", tmp_path / "made"
    )
    assert f"contact.{key}" in message


def test_a_deck_of_results_without_the_contact_model_is_refused(copy, tmp_path, capfd):
    path = copy / "summary.json"
    content = json.loads(path.read_text())
    del content["contact"]
    path.write_text(json.dumps(content))
    _rehash(copy)
    out = tmp_path / "deck.inp"
    message = refused(capfd, "export", copy, "--deck", "ccx", "--frame", 0, "--out", out)
    assert "does not name the contact model" in message


def test_a_frame_without_its_flexion_is_refused(copy, capfd):
    path = copy / "results.csv"
    head, row = path.read_text().splitlines()[:2]
    cells = row.split(",")
    cells[head.split(",").index("flexion_deg")] = "nan"
    path.write_text(f"{head}\n{','.join(cells)}\n")
    _rehash(copy)
    assert "'flexion_deg' is not a number" in refused(capfd, "report", copy)


def test_a_table_without_frames_is_refused(copy, capfd):
    path = copy / "results.csv"
    path.write_text(path.read_text().partition("\n")[0] + "\n")
    _rehash(copy)
    for command in ("report", "methods"):
        assert "no frame" in refused(capfd, command, copy)


def test_maps_of_another_shape_are_refused(copy, capfd):
    with h5py.File(copy / "contact.h5", "a") as file:
        del file["pressure_Pa"]
        file.create_dataset("pressure_Pa", (10**6, 10**6), "f8", chunks=(1, 100))
    _rehash(copy)
    assert "pressure_Pa" in refused(capfd, "report", copy)


def test_verify_escapes_control_characters_and_writes_errors_to_stderr(copy, capfd):
    path = copy / "summary.json"
    summary = json.loads(path.read_text())
    summary["inputs"] = {"/nothing/\x1b[31mred\nline": "0" * 64}
    path.write_text(json.dumps(summary))
    _rehash(copy)
    capfd.readouterr()
    assert main(["verify", str(copy)]) == 1
    printed = capfd.readouterr()
    assert "\x1b" not in printed.out + printed.err
    assert "no such file" in printed.err
