"""Inputs that would take hours, gigabytes or the whole disk are refused in one line."""

import os
import subprocess
import sys

import pytest

from scenes import write_scene
from tkamb.commands.options import _setting
from tkamb.contact.registry import contact_model
from tkamb.errors import InputError
from tkamb.files import HASH_LIMIT, sha256_of
from tkamb.io.claim import claimed_directory, is_ours
from tkamb.io.recordings.urdf_check import _check_attributes
from tkamb.io.toml_text import parse_toml
from tkamb.run.guard import guarded
from tkamb.studies.wear.report import STATE_NAME
from tkamb.studies.wear.run import kept_state


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a." + ".".join("b" * 100_000) + " = 1", "parts"),
        ("[" + ".".join("b" * 100_000) + "]", "parts"),
        ("a = " + "1" * 5_000, "digits"),
        ("a = 0x" + "f" * 5_000, "digits"),
        ("a = " + "[" * 5_000 + "]" * 5_000, "nests"),
        ("a = " + "{a=" * 5_000 + "1" + "}" * 5_000, "nests"),
        ("a = 1\na = 2", "not TOML"),
    ],
)
def test_toml_that_takes_long_to_parse_is_refused(text, words):
    with pytest.raises(InputError, match=words):
        parse_toml(text, "scene.toml")


def test_long_texts_with_brackets_and_dots_are_read():
    text = 'a = "' + "x." * 50 + "[" * 50 + "1" * 200 + '"  # ' + "[" * 50 + "\nb.c = [[1, 2]]"
    assert parse_toml(text, "scene.toml")["b"] == {"c": [[1, 2]]}
    assert _setting("a.b=[1, 2]") == ("a.b", [1, 2])


@pytest.mark.parametrize("value", [0, -1.0, float("nan"), float("inf"), 1e300, 1.0])
def test_an_impossible_tolerance_is_refused(value):
    with pytest.raises(InputError, match="tolerance"):
        contact_model("lattice", tolerance=value)


def test_an_origin_far_beyond_the_body_is_refused():
    from xml.etree.ElementTree import fromstring

    with pytest.raises(InputError, match="millimetres"):
        _check_attributes(fromstring('<origin xyz="0 1e300 0"/>'), "leg.urdf")
    _check_attributes(fromstring('<origin xyz="0 -0.4 0" rpy="0 0 0"/>'), "leg.urdf")


def test_a_file_above_the_limit_is_not_hashed(tmp_path):
    path = tmp_path / "large"
    os.truncate(os.open(path, os.O_CREAT | os.O_WRONLY), int(HASH_LIMIT) + 1)
    with pytest.raises(InputError, match="MB large"):
        sha256_of(path)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"x" * 100, bytes(1000)])
def test_a_damaged_wear_state_is_refused(tmp_path, content):
    (tmp_path / STATE_NAME).write_bytes(content)
    with pytest.raises(InputError, match="damaged"):
        kept_state(tmp_path, "identity")


WRITER = """
import resource, sys
import numpy as np
from tkamb.run.maps import MapWriter
from tkamb.errors import InputError
limit = int(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
chance = np.random.default_rng(1)
try:
    with MapWriter(sys.argv[2], chance.random((500, 3)), np.zeros((1, 3), int), {}) as writer:
        for k in range(40):
            pressure, gap = chance.random((2, 500))
            writer.append(k, pressure, gap, chance.random((500, 3)), np.eye(4))
            writer.flush()
except InputError as error:
    print(error)
    sys.exit(3)
"""


@pytest.mark.parametrize("limit", [100, 5_000, 100_000, 500_000])
def test_a_file_size_limit_ends_the_maps_with_one_line(tmp_path, limit):
    command = [sys.executable, "-c", WRITER, str(limit), str(tmp_path / "contact.h5")]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    assert process.returncode == 3, process.stderr
    assert "cannot be written (File too large)" in process.stdout and not process.stderr


def test_a_folder_stays_claimed_after_a_failed_write(tmp_path):
    out = tmp_path / "out"

    def fails():
        with claimed_directory(out) as folder:
            (folder / STATE_NAME).touch()
            raise InputError("cannot be written")

    with pytest.raises(InputError):
        fails()
    assert is_ours(out)
    with claimed_directory(out):
        pass


def test_an_interrupt_without_files_states_that_nothing_is_kept(capfd):
    import argparse

    def command():
        raise KeyboardInterrupt

    assert guarded(command, argparse.Namespace()) == 130
    assert capfd.readouterr().err == "tkamb: interrupted: nothing is kept\n"


def test_a_full_disk_is_one_line(capfd):
    import argparse
    import errno

    def command():
        raise OSError(errno.ENOSPC, "No space left on device", "results.csv")

    assert guarded(command, argparse.Namespace()) == 1
    output = capfd.readouterr().err
    assert output.count("\n") == 1 and "results.csv: cannot be written" in output


def test_a_worker_ends_silently_with_its_parent():
    command = [sys.executable, "-m", "tkamb.run.workers"]
    process = subprocess.run(command, input=b"", capture_output=True, check=False)
    assert (process.returncode, process.stderr) == (0, b"")


def test_an_unknown_backend_of_matplotlib_is_ignored(tmp_path):
    drop = ("contact", "implant", "patella", "patellar_ligament", "quadriceps", "ligament")
    scene = write_scene(tmp_path / "scene", drop)
    command = [sys.executable, "-m", "tkamb", "check", "--out", str(tmp_path / "a.png"), str(scene)]
    environment = os.environ | {"MPLBACKEND": "no-such-backend"}
    process = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
