#!/usr/bin/env python3
"""Build the sdist from the files in git, and the wheel from the sdist.

Usage: scripts/build_package.py FOLDER
       scripts/build_package.py --floors    print the lowest allowed version of each dependency
"""

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
from pathlib import Path

from setuptools import build_meta

ROOT = Path(__file__).parents[1]


def build(folder: Path) -> tuple[Path, Path]:
    """Build sdist and wheel in the folder; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as temporary:
        source = Path(temporary) / "source"
        for name in known_files():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, source / name)
        try:
            os.chdir(source)
            sdist = folder / build_meta.build_sdist(str(folder))
            with tarfile.open(sdist) as archive:
                archive.extractall(temporary, filter="data")
            os.chdir(Path(temporary) / sdist.name.removesuffix(".tar.gz"))
            wheel = folder / build_meta.build_wheel(str(folder))
        finally:
            os.chdir(before)
    return sdist, wheel


def known_files() -> list[str]:
    """Return the paths of the existing files in git."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True
    ).stdout
    return [name for name in listed.split("\0") if name and (ROOT / name).is_file()]


def floors() -> list[str]:
    """Return the lowest allowed versions of the dependencies and extras, as constraints of pip."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        project = tomllib.load(file)["project"]
    extras = project["optional-dependencies"]
    users = [line for name in ("data", "muscles", "cohort", "cluster") for line in extras[name]]
    return [
        line.partition(",")[0].replace(">=", "==") for line in (*project["dependencies"], *users)
    ]


if __name__ == "__main__":
    if sys.argv[1] == "--floors":
        sys.exit(print("\n".join(floors())))
    print("\n".join(str(made) for made in build(Path(sys.argv[1]).resolve())))
