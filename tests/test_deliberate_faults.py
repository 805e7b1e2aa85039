"""Each fault of deliberate_faults.toml, a change of one line, makes its test fail."""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FAULTS = tomllib.loads((ROOT / "tests" / "deliberate_faults.toml").read_text("utf-8"))["fault"]
COPIED = ("tkamb", "tests", "models", "scripts", "docs", "pyproject.toml", "README.md")


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault["physics"])
def test_the_line_is_there_once_and_the_test_exists(fault):
    assert (ROOT / fault["file"]).read_text("utf-8").count(fault["before"]) == 1
    file, _, name = fault["test"].partition("::")
    assert f"def {name}" in (ROOT / file).read_text("utf-8")


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """Return a copy of the project for the faults, with a link to the data beside it."""
    folder = tmp_path_factory.mktemp("faults")
    project = folder / "project"
    project.mkdir()
    for name in COPIED:
        source, target = ROOT / name, project / name
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, target)
    if (ROOT.parent / "shared").exists():
        (folder / "shared").symlink_to((ROOT.parent / "shared").resolve())
    return project


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault["physics"])
def test_the_fault_makes_its_test_fail(tree, fault):
    """The named test fails with the fault. Without it, the test passes as part of the suite."""
    path = tree / fault["file"]
    original = path.read_text("utf-8")
    path.write_text(original.replace(fault["before"], fault["after"]), "utf-8")
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", fault["test"]]
    settings = {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        process = subprocess.run(
            command, cwd=tree, env=os.environ | settings, capture_output=True, text=True
        )
    finally:
        path.write_text(original, "utf-8")
    assert process.returncode == 1, process.stdout[-2000:]
    assert "1 failed" in process.stdout
