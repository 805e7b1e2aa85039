"""Report of the trade-off: table, recommendations, figure, and the pages made from its JSON."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from error_cases import SITUATIONS
from error_rows import read_error_rows
from known_error_tables import stated_table, tables
from tkamb.errors import InputError
from tkamb.run.known_errors import (
    STORED,
    known_error,
    known_error_words,
    known_errors,
)
from tkamb.run.known_errors import (
    as_json as error_json,
)
from tkamb.show.tradeoff_report import comparison, picture, recommendations, table
from tkamb.studies.measures import Job, Measure
from tkamb.studies.references import read_references
from tkamb.studies.tradeoff import KEYS, TIMES, Row, as_json, read_body_rows, read_rows, with_fronts
from tradeoff_blocks import (
    MARKERS,
    WIDENING,
    block,
    body_block,
    known_errors_json,
    short_block,
    with_block,
)

ROOT = Path(__file__).parents[1]
MEASURED = ROOT / "scripts" / "data"
JSON_KEYS = {
    *("case", "contact", "resolution_mm", "on_front", "status", "reference_known", "values"),
    *TIMES,
    *(f"error_{key}" for key in KEYS),
}


def made_up_rows():
    settings = [("hertz", 2.0, 1e-3, 0.2), ("foundation", 2.0, 1e-2, 0.3)]
    settings += [("lattice", 2.0, 1e-2, 0.01), ("fe", 2.0, 1.0, 0.001)]
    rows = []
    for case in ("sphere", "two condyles", "conforming"):
        for contact, grid, seconds, error in settings:
            values = dict.fromkeys(read_references()[case].values, 1.0 + error)
            measure = Measure("ok", 1.0, seconds, seconds, 100.0, values=values)
            row_errors = dict.fromkeys(KEYS, error)
            rows.append(Row(Job(case, contact, grid), measure, row_errors, 0.005))
        rows.append(Row(Job(case, "lattice", 1.0), Measure("out of range"), {}, 0.005))
    return with_fronts(rows)


def test_the_rows_of_a_study_give_json_table_and_advice():
    rows = made_up_rows()
    assert [row.on_front for row in rows[:5]] == [True, False, True, True, False]
    content = json.loads(as_json(rows))
    assert all(set(row) == JSON_KEYS for row in content)
    assert content[4]["error_approach"] is None
    text = "\n".join(table(rows, read_references()))
    assert "out of range" in text and "*hertz" in text
    advice = recommendations(rows)
    for key in ("approach", "condyle force", "mean pressure", "peak pressure", "area", "map"):
        assert any(f" in {key}" in line or f"{key} (L2)" in line for line in advice), key
    assert any("5 % in peak pressure" in line and "lattice at 2 mm" in line for line in advice)
    assert picture(rows).axes


def test_labels_of_a_short_axis_do_not_overlap():
    """The times are 8 to 70 ms, like those of the quick study."""
    rows = [
        replace(row, measure=replace(row.measure, warm_seconds=8e-3 * 1.25**k))
        for k, row in enumerate(made_up_rows()[:10])
    ]
    figure = picture(rows)
    figure.draw_without_rendering()
    for axis in figure.axes:
        ticks = [*axis.xaxis.get_major_ticks(), *axis.xaxis.get_minor_ticks()]
        low, high = axis.get_xlim()
        labels = [t.label1 for t in ticks if low <= t.get_loc() <= high and t.label1.get_text()]
        boxes = sorted((label.get_window_extent() for label in labels), key=lambda box: box.x0)
        assert len(boxes) > 1
        assert all(a.x1 < b.x0 for a, b in pairwise(boxes))


def test_two_cases_give_no_recommendation():
    rows = [row for row in made_up_rows() if row.job.case != "conforming"]
    (advice,) = recommendations(rows)
    assert "run the whole study" in advice and "hertz" not in advice


def test_a_limit_that_no_setting_meets_names_the_nearest_setting():
    rows = [row for row in made_up_rows() if row.job.contact in ("hertz", "foundation")]
    assert all(
        "no setting: the nearest is hertz at 2 mm with 20 %" in r for r in recommendations(rows)
    )


def test_the_comparison_has_the_measured_times():
    lines = comparison(made_up_rows())
    assert "10 ms" in lines[0] and "is on the front" in lines[0]
    assert "fe at 2 mm: 1000 ms, 100 times as long as lattice; it shares" in lines[1]
    rows = [replace(row, measure=replace(row.measure, warm_seconds=0.02)) for row in made_up_rows()]
    peer = replace(rows[8], job=Job("two condyles", "calculix C3D8I", 2.0))
    assert "0.9 % in approach" in comparison([*rows, peer])[-1]
    finer = [replace(row, job=replace(row.job, resolution_mm=1.0)) for row in (*rows, peer)]
    assert comparison([*rows, *finer])[-1].startswith("calculix C3D8I at 1 mm: 20 ms, 1 times")


def test_rows_are_read_back_from_json(tmp_path):
    path = tmp_path / "tradeoff.json"
    path.write_text(as_json(made_up_rows()))
    read = read_rows(path)
    assert as_json(read) == path.read_text()
    assert block(read) == block(made_up_rows())
    path.write_text('[{"case": 1}]')
    with pytest.raises(InputError, match="not a table of a trade-off"):
        read_rows(path)


def test_a_block_is_inserted_between_its_markers():
    begin, end = (marker.format("tradeoff") for marker in MARKERS)
    page = f"before\n{begin}\nold\n{end}\nafter\n"
    filled = with_block(page, ["| a |", "| b |"])
    assert filled == f"before\n{begin}\n\n| a |\n| b |\n\n{end}\nafter\n"
    assert with_block(filled, ["| a |", "| b |"]) == filled
    with pytest.raises(InputError, match="once each"):
        with_block("no markers", [])


def test_the_tables_of_the_pages_agree_with_the_study():
    rows = read_rows(MEASURED / "tradeoff.json")
    body = read_body_rows(MEASURED / "body.json")
    for page, lines, name in (
        ("README.md", short_block(rows), "short"),
        ("docs/studies.md", block(rows), "tradeoff"),
        ("docs/studies.md", body_block(body), "body"),
    ):
        text = (ROOT / page).read_text(encoding="utf-8")
        assert with_block(text, lines, name) == text, f"{page}: run scripts/make/tradeoff_table"


def error_cases_rows():
    return read_error_rows(MEASURED / "known_error_cases.json")


def test_stored_known_errors_and_their_page_agree_with_both_studies():
    rows, cases = read_rows(MEASURED / "tradeoff.json"), error_cases_rows()
    assert STORED.read_text(encoding="utf-8") == known_errors_json(rows, cases)
    page = (ROOT / "docs" / "known_errors.md").read_text(encoding="utf-8")
    assert with_block(page, tables(cases), "known-errors") == page, (
        "run scripts/measure/known_errors"
    )
    entries = json.loads(STORED.read_text(encoding="utf-8"))
    assert with_block(page, stated_table(entries), "stated-errors") == page, (
        "run scripts/make/tradeoff_table"
    )
    (variant,) = [e for key, e in known_errors().items() if key[0] == "lattice[tolerance=0.01]"]
    widened = 1.0 + WIDENING / variant.pairs
    lines = (ROOT / "docs" / "studies.md").read_text(encoding="utf-8").splitlines()
    (line,) = [line for line in lines if line.startswith("| lattice[tolerance=0.01] | 2 |")]
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    shares = variant.approach, variant.force, variant.mean_pressure, variant.peak_pressure
    assert [float(cell) for cell in cells[6:10:2]] == pytest.approx(
        [100 * share / widened for share in shares[::2]], rel=0.06
    )


def test_the_widened_largest_error_of_some_pairs_covers_the_others():
    """Why an error is widened by 1 + 3/n: on the pairs that the stated errors come from."""
    groups: dict[tuple[str, str], list[list[float]]] = {}
    for row in error_cases_rows():
        if row.resolution_mm == 1.0 and row.errors and not row.held_out:
            groups.setdefault((row.contact, row.material), []).append(list(row.errors.values()))
    random = np.random.default_rng(0)
    for n in (4, 8, 12):
        inside = []
        for errors in (np.array(group) for group in groups.values() if len(group) > n):
            for _ in range(100):
                order = random.permutation(len(errors))
                limit = (1.0 + WIDENING / n) * errors[order[:n]].max(axis=0)
                inside += list((errors[order[n:]] <= limit).ravel())
        assert np.mean(inside) >= 0.94


def test_each_situation_has_seven_cases_and_half_are_held_out():
    rows = error_cases_rows()
    for situation in SITUATIONS:
        pairs = {(row.case, row.held_out) for row in rows if row.situation == situation}
        assert len(pairs) >= 7
        assert abs(sum(held for _, held in pairs) - len(pairs) / 2) <= 1
    assert {row.material for row in rows} == {"polyethylene", "polyethylene-linear"}


def test_held_out_cases_do_not_affect_the_known_errors():
    rows = error_cases_rows()
    changed = [replace(r, errors=dict.fromkeys(r.errors, 9.0)) if r.held_out else r for r in rows]
    study = read_rows(MEASURED / "tradeoff.json")
    entries, changed_entries = (
        json.loads(known_errors_json(study, subset)) for subset in (rows, changed)
    )
    for entry, changed_entry in zip(entries, changed_entries, strict=True):
        assert {k: v for k, v in entry.items() if k != "covered"} == {
            k: v for k, v in changed_entry.items() if k != "covered"
        }
        assert changed_entry["covered"] in (None, 0.0)


@pytest.mark.parametrize("contact", ["lattice", "fe", "lattice-linear"])
def test_known_errors_at_1_mm_cover_the_held_out_cases(contact):
    error = known_error(contact, 1.0, "polyethylene")
    assert error.covered >= 0.9


def test_a_known_error_names_its_cases_and_situations():
    error = error_json(known_error("lattice", 1.0, "polyethylene"))
    words = known_error_words(error, ("peak_pressure", "area", "approach"))
    assert words.startswith(
        f"In {error['cases']} reference cases the error of the contact model, widened for "
        f"{error['pairs']} pairs of bodies, was at most "
    )
    for place in ("in the interior", "on a flank", "at an edge"):
        assert place in words
    assert error["situations"]["edge"]["area"] > error["situations"]["interior"]["area"]


def test_settings_without_measurement_have_no_known_error():
    assert known_error("lattice", 1.0, "polyethylene", {}).cases >= 12
    assert known_error("lattice", 1.0, "polyethylene", {"cache": False}) is not None
    assert known_error("lattice", 2.0, "polyethylene", {"tolerance": 1e-2}) is not None
    assert known_error("lattice-linear", 1.0, "polyethylene-linear", {}) is not None
    for model, resolution, material, options in (
        ("lattice", 1.25, "polyethylene", {}),
        ("lattice", 1.0, "polyethylene-linear", {}),
        ("lattice", 1.0, "polyethylene", {"tolerance": 1e-2}),
        ("winkler", 1.0, "polyethylene", {}),
        ("calculix C3D8I", 1.0, "polyethylene", {}),
    ):
        assert known_error(model, resolution, material, options) is None
