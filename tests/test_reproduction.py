"""The page on the dissertation has the printed numbers and names existing files and tests."""

import ast
import json
import re
from pathlib import Path

import pytest

from tkamb.io.presets import find_preset
from validation import dissertation, reproduction
from validation.reproduction_page import facts, names_in, page

ROOT = Path(__file__).parents[1]
MODEL = ROOT / "models" / "deep_knee_bend"
STORED = json.loads((ROOT / "scripts" / "data" / "dissertation.json").read_text(encoding="utf-8"))
VALIDATED = json.loads((ROOT / "scripts" / "data" / "validation.json").read_text(encoding="utf-8"))[
    "values"
]


def test_the_page_is_what_its_numbers_make():
    written = (ROOT / "docs" / "dissertation.md").read_text(encoding="utf-8")
    assert written == page(STORED, VALIDATED, find_preset("sharma-2008").settings)


@pytest.mark.parametrize(
    "row", facts()["element"], ids=lambda row: f"{row['section']} {row['name']}"
)
def test_an_element_of_chapter_4_is_where_the_page_says(row):
    assert (ROOT / row["code"]).is_file()
    file, _, name = row["test"].partition("::")
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert functions
    assert not name or name in functions


def test_every_element_has_a_section_of_chapter_4_and_every_section_an_element():
    sections = {row["section"] for row in facts()["element"]}
    assert sections == {"4.1", "4.2", "4.3", "4.4", *(f"4.5.{k}" for k in range(1, 7))}


PRINTED = {
    "5.1": "1000 561.5 0.45 2 9.11 3.40 8.64 3.33",
    "5.2": "561.5 0.0389 8.4194 4.5485 1 15 120",
    "5.2.1": "3.84 103 3.81 100 0.15 0.3 1.5",
    "5.2.2": "0.001",
    "5.2.3": "0.78 1.23 0.87 1.15",
    "5.2.4": "0.02",
    "5.2.5": "7",
    "5.2.6": "15 5",
    "5.2.7": "32 3.6 1.8 56",
}
"""Section of chapter 5 -> the numbers printed in it."""


@pytest.mark.parametrize("section", PRINTED)
def test_every_number_of_chapter_5_stands_in_the_table(section):
    rows = [row for row in facts()["comparison"] if row["section"] == section]
    sections = " ".join(row["source"] for row in rows)
    numbers = set(re.findall(r"\d+(?:\.\d+)?", sections))
    assert set(PRINTED[section].split()) <= numbers
    for row in rows:
        assert row["kind"].startswith(("compared", "same input", "cannot be compared"))
        if row["kind"].startswith("compared"):
            assert names_in(row["number"]), row["what"]


def test_numbers_of_the_page_are_stored_and_none_is_left_over():
    rows = facts()["element"] + facts()["comparison"]
    names = {name for row in rows for name in names_in(row["number"])}
    assert names <= set(STORED["values"]) | set(VALIDATED)
    assert set(STORED["values"]) <= names


def test_appendix_d_has_every_tenth_of_the_bend():
    percent = [row["percent"] for row in STORED["bend"]]
    assert percent == dissertation.table(1).percent.tolist()
    for row in STORED["bend"]:
        assert all(f"D-{number}" in row for number in range(1, 13))
        si = row["D-12"]
        assert row["D-1"] + row["D-2"] == pytest.approx(si, rel=0.03)


def test_stored_numbers_that_are_fast_to_compute_are_reproduced():
    computed = reproduction.template() | reproduction.adjustment(MODEL)
    for name, value in computed.items():
        assert value == pytest.approx(STORED["values"][name], rel=1e-3), name
