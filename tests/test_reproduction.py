"""The page on the dissertation, its tables D-1 to D-12, and the tests and files that it names."""

import ast
import json
import re
from pathlib import Path

import numpy as np
import pytest

from tkamb.errors import InputError
from tkamb.io.presets import find_preset
from validation import dissertation, reproduction
from validation import dissertation as d
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


FINDINGS = {row["check"]: row for row in d.findings()}


def below_zero(values, rounding=5e-3):
    """Return design -> per cent of the knee bend at which values are below -rounding."""
    percent = d.table(1).percent.astype(int)
    cells = {name: percent[values[:, i] < -rounding].tolist() for i, name in enumerate(d.designs())}
    return {name: rows for name, rows in cells.items() if rows}


def test_twelve_tables_of_eleven_rows_and_six_designs():
    for number in range(1, 13):
        table = d.table(number)
        assert table.mean.shape == table.deviation.shape == (11, 6)
        assert table.percent.tolist() == list(range(0, 101, 10))
        assert table.heading.endswith(f"({table.unit})")
        assert (table.mean > 0.0).all() and (table.deviation > 0.0).all()
    assert sum(d.subjects(name) for name in d.designs()) == 29
    with pytest.raises(InputError, match="no table D-13"):
        d.table(13)


def test_nkii_columns_of_d12_are_exchanged():
    finding = FINDINGS["si_surplus"]
    printed, exchanged = d.si_surplus(False), d.si_surplus(True)
    exchanged_designs = [n for i, n in enumerate(d.designs()) if np.abs(printed[:, i]).max() > 0.1]
    assert exchanged_designs == finding["designs"]
    assert np.abs(printed).max() == pytest.approx(finding["largest_as_printed_BW"], abs=5e-3)
    assert np.abs(exchanged).max() == pytest.approx(finding["largest_exchanged_BW"], abs=5e-3)
    assert (exchanged < 5e-3).all()


def test_patellar_equilibrium_is_violated_in_the_named_cells():
    finding, surplus = FINDINGS["patellar_surplus"], d.patellar_surplus()
    assert below_zero(surplus) == finding["cells"]
    assert -surplus.min() == pytest.approx(finding["largest_BW"], abs=5e-3)


def test_both_sigma_designs_imply_heavier_subjects():
    finding, mass = FINDINGS["implied_mass"], d.implied_mass()
    is_sigma = np.array([name in finding["designs"] for name in d.designs()])
    means = mass.mean(axis=0)
    np.testing.assert_allclose(means[is_sigma], finding["mean_kg"], atol=0.05)
    others = means[~is_sigma]
    np.testing.assert_allclose(
        [others.min(), others.max()], finding["other_designs_mean_kg"], atol=0.05
    )
    per_condyle = np.stack(
        [
            d.table(area).mean * d.table(area + 2).mean / d.table(area - 2).mean / d.GRAVITY
            for area in (d.MEDIAL_AREA, d.LATERAL_AREA)
        ]
    )[:, :, is_sigma]
    assert [round(per_condyle.min()), round(per_condyle.max())] == finding["per_condyle_kg"]


def test_text_and_tables_disagree_on_the_start():
    finding = FINDINGS["start"]
    start = (d.table(1).mean + d.table(2).mean)[0].mean()
    assert start == pytest.approx(finding["table_BW"], abs=5e-3)
    assert start > 1.5 * finding["text_BW"]


def test_contact_exceeds_ligament_and_body_weight_at_the_end():
    finding = FINDINGS["unexplained_pull"]
    row = d.table(1).percent.tolist().index(finding["at_percent"])
    np.testing.assert_allclose(d.unexplained_pull()[row], finding["least_BW"], atol=5e-3)


def test_no_row_of_d3_is_repeated():
    rows = d.table(d.MEDIAL_AREA).mean
    assert len(np.unique(rows, axis=0)) == len(rows) - len(FINDINGS["repeated_rows"]["repeated"])
