"""Release files agree with the package: wheel, recipe, citation, bill of materials, checklists."""

import importlib.util
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.machinery import SourceFileLoader
from pathlib import Path

import yaml

import tkamb

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
CONDA = {"pin": "pinocchio", "meshcat": "meshcat-python", "matplotlib": "matplotlib-base"}
"""Name on PyPI -> name on conda-forge, where they differ."""


def test_the_recipe_has_the_dependencies_and_the_version_of_the_package():
    text = (ROOT / "scripts" / "conda" / "recipe.yaml").read_text(encoding="utf-8")
    recipe = yaml.safe_load(text)
    assert recipe["schema_version"] == 1 and recipe["build"]["noarch"] == "python"
    assert recipe["context"]["version"] == tkamb.__version__
    assert PROJECT["requires-python"] == f">={recipe['context']['python_min']}"
    parts = (re.fullmatch(r"([\w-]+)(.*)", one) for one in PROJECT["dependencies"])
    expected = {f"{CONDA.get(one[1], one[1])} {one[2]}" for one in parts if one}
    python, *needed = recipe["requirements"]["run"]
    assert python == "python >=${{ python_min }}" and set(needed) == expected
    (entry,) = recipe["build"]["python"]["entry_points"]
    assert entry == f"tkamb = {PROJECT['scripts']['tkamb']}"
    assert recipe["about"]["license"] == PROJECT["license"] == "Apache-2.0"


def test_the_citation_is_complete_and_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    for key in ("cff-version", "message", "title", "authors"):  # required by its schema
        assert citation[key]
    assert citation["version"] == tkamb.__version__
    assert citation["license"] == PROJECT["license"] and citation["type"] == "software"


def test_the_bill_of_materials_names_every_dependency_with_its_version():
    path = str(ROOT / "scripts" / "make" / "sbom")
    loader = SourceFileLoader("sbom", path)
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader(loader.name, loader))
    loader.exec_module(module)
    document = module.document()
    names = {row["SPDXID"].removeprefix("SPDXRef-"): row for row in document["packages"]}
    for one in PROJECT["dependencies"]:
        assert re.split(r"[<>=]", one)[0].lower() in names
    assert all(row["versionInfo"] for row in names.values())
    assert names["tkamb"]["licenseDeclared"] == "Apache-2.0"
    linked = {
        link["relatedSpdxElement"].removeprefix("SPDXRef-") for link in document["relationships"]
    }
    assert linked | {"tkamb"} == set(names)


def test_the_paper_has_the_sections_that_joss_requires():
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    for heading in (
        "Summary", "Statement of need", "State of the field", "Software design",
        "Research impact statement", "AI usage disclosure", "Acknowledgements", "References",
    ):  # fmt: skip
        assert f"\n# {heading}\n" in text


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
