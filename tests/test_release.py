"""Release files agree with the package: recipe, citation, bill of materials, checklists."""

import importlib.util
import re
import tomllib
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
