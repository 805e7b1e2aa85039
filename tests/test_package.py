"""The wheel that is built from the sdist holds exactly the files of the package."""

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_wheel_made_from_the_sdist_holds_the_whole_package(tmp_path):
    process = subprocess.run(
        [sys.executable, ROOT / "scripts" / "build_package.py", tmp_path],
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, process.stderr
    (wheel,) = tmp_path.glob("*.whl")
    assert len(list(tmp_path.glob("*.tar.gz"))) == 1
    listed = subprocess.run(
        ["git", "ls-files", "tkamb"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (entry,) = (name for name in names if name.endswith("entry_points.txt"))
        assert "tkamb = tkamb.__main__:main" in archive.read(entry).decode()
        assert any(name.endswith("licenses/LICENSE") for name in names)
    packed = {name for name in names if ".dist-info/" not in name}
    assert packed == {name for name in listed if (ROOT / name).is_file()}


def test_python_m_tkamb_is_the_command():
    process = subprocess.run(
        [sys.executable, "-m", "tkamb", "--version"], capture_output=True, text=True, check=True
    )
    assert process.stdout.startswith("tkamb ")


def test_a_folder_that_holds_the_clone_does_not_hide_the_package(tmp_path):
    """With an editable install, a folder `tkamb` without __init__ does not hide the package."""
    (tmp_path / "tkamb").symlink_to(ROOT)
    with (ROOT / "pyproject.toml").open("rb") as file:
        assert tomllib.load(file)["tool"]["setuptools"]["package-dir"] == {"": "."}
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "editable.pth").write_text(f"{ROOT}\n")
    code = (
        "import site, sys\n"
        f"sys.path = [''] + [p for p in sys.path if p not in ('', {str(ROOT)!r})]\n"
        f"site.addsitedir({str(tmp_path / 'site')!r})\n"
        "import tkamb\n"
        "print(tkamb.__file__)"
    )
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert Path(process.stdout.strip()).resolve() == ROOT / "tkamb" / "__init__.py"
