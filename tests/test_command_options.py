"""The option --no-cache, and the number of threads that the command line sets."""

import os
import subprocess
import sys

import pytest

from scenes import fast_scene
from tkamb.cli import main

SCENE = fast_scene()


@pytest.mark.slow
def test_no_cache_writes_no_cache(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("TKAMB_CACHE_DIR", str(tmp_path / "kept"))
    run = ["run", str(SCENE), "--frames", "50:51", "--resolution", "1.5", "--contact"]
    first, second = tmp_path / "first", tmp_path / "second"
    assert main([*run, "lattice-linear", "--out", str(first), "--no-cache"]) == 0
    assert not (tmp_path / "kept").exists()
    assert main([*run, "lattice-linear", "--out", str(second)]) == 0
    assert any((tmp_path / "kept").iterdir())
    assert main([*run, "foundation", "--out", str(tmp_path / "third"), "--no-cache"]) == 2
    assert "'foundation' has no cache on disk" in capsys.readouterr().err
    assert not (tmp_path / "third").exists()


@pytest.mark.parametrize(("setting", "threads"), [({}, "1"), ({"OMP_NUM_THREADS": "3"}, "3")])
def test_blas_uses_one_thread_unless_the_environment_sets_a_number(setting, threads):
    code = (
        "import os, sys; from tkamb.cli import main; main(['contact', 'list']); "
        "print(os.environ['OMP_NUM_THREADS'])"
    )
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    process = subprocess.run(
        [sys.executable, "-c", code],
        env=environment | setting,
        capture_output=True,
        text=True,
        check=True,
    )
    assert process.stdout.splitlines()[-1] == threads
