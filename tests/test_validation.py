"""The validation page: it agrees with its JSON, and a tenth of its values is computed again."""

import json
from pathlib import Path

import numpy as np
import pytest

from tkamb.studies.designs.design import load_design
from validation import benchmarks, dissertation
from validation.design_cells import (
    PressedDesign,
    in_public_units,
    nominal,
    table_force,
)
from validation.design_tables import FOLDERS, QUANTITIES, pressed_row
from validation.film import PressureFilm, hertz_field, worst_errors
from validation.page import badge, hit, page, published

ROOT = Path(__file__).parents[1]
STORED = json.loads((ROOT / "scripts" / "data" / "validation.json").read_text(encoding="utf-8"))
VALUES = {row["id"]: row for row in published()["value"]}


def stored_row(design, condyle, percent):
    key = (design, condyle, percent)
    rows = STORED["tables"]
    return next(r for r in rows if (r["design"], r["condyle"], r["percent"]) == key)


def test_the_page_agrees_with_the_stored_numbers():
    assert (ROOT / "docs" / "validation.md").read_text(encoding="utf-8") == page(STORED)


def test_every_published_value_has_a_source_a_band_and_a_computed_value():
    sources = {row["key"] for row in published()["source"]}
    assert set(STORED["values"]) <= set(VALUES)
    assert len(STORED["values"]) >= 10
    assert {row["source"] for row in VALUES.values()} == sources
    assert len(VALUES) >= 10 and len(sources) >= 5
    for row in VALUES.values():
        assert row["low"] < row["high"]
    assert np.isfinite(list(STORED["values"].values())).all()


def test_the_badge_counts_values_within_their_bands():
    stored = STORED["values"]
    within = sum(hit(VALUES[name], value) for name, value in stored.items())
    assert badge(stored).startswith(f"**{within} of {len(stored)} ")


def test_fast_values_agree_with_the_stored_ones():
    computed = {**benchmarks.film(), **benchmarks.patch(), **benchmarks.refinement()}
    computed |= benchmarks.speed(ROOT / "scripts" / "data" / "tradeoff.json")
    for name, value in computed.items():
        assert value == pytest.approx(STORED["values"][name], rel=1e-3), name


def test_a_tenth_of_the_tables_agrees_with_the_stored_one():
    name = "NKII CP"
    pressed = PressedDesign(load_design(ROOT / "models" / "designs" / FOLDERS[name]))
    percent = dissertation.table(1).percent
    for row in range(11):
        cell = pressed.cell("medial", percent[row], table_force(name, "medial", row), nominal())
        stored = stored_row(name, "medial", percent[row])
        computed = dict(zip(QUANTITIES, in_public_units([cell])[0], strict=True))
        for quantity, value in computed.items():
            assert value == pytest.approx(stored[quantity][0], rel=5e-3), (row, quantity)
    row = pressed_row(pressed, name, "medial", 10)
    for quantity in QUANTITIES:
        np.testing.assert_allclose(
            row[quantity], stored_row(name, "medial", 100.0)[quantity], rtol=5e-3
        )


@pytest.mark.slow
def test_all_values_agree_with_the_stored_ones():
    designs = ROOT / "models" / "designs"
    computed = {
        **benchmarks.spheres(),
        **benchmarks.against_fe(designs),
        **benchmarks.foundation(designs),
        **benchmarks.given_load_or_approach(),
        **benchmarks.conformity(designs),
        **benchmarks.measured_stress(designs),
        **benchmarks.thickness_and_plane(designs),
    }
    for name, value in STORED["values"].items():
        if name in computed:
            assert value == pytest.approx(computed[name], rel=0.01), name


def test_the_area_of_a_pressure_film_converges_to_the_ellipse():
    """The worst error of the area decreases at least with power 0.8 of the cell size."""
    cells = np.array([2e-3, 1e-3, 0.5e-3])
    errors = [worst_errors((8e-3, 5e-3), cell, places=8)["area"] for cell in cells]
    assert np.polyfit(np.log(cells), np.log(errors), 1)[0] > 0.8


def test_a_pressure_film_measures_a_uniform_pressure_exactly():
    cell = 1e-3

    def field(x, z):
        return np.where((np.abs(x) < 5e-3) & (np.abs(z) < 5e-3), 3e6, 0.0)

    reading = PressureFilm(cell).read(field, np.full(2, -5e-3), np.full(2, 5e-3))
    assert reading.cells == 100 and reading.perimeter_cells == 36
    assert reading.force == pytest.approx(300.0)
    assert reading.mean_pressure == pytest.approx(3e6)
    assert (
        PressureFilm(cell, threshold=4e6).read(field, np.full(2, -5e-3), np.full(2, 5e-3)).cells
        == 0
    )


def test_errors_of_a_pressure_film_increase_with_the_perimeter_share():
    share, area = [], []
    for size in (4e-3, 6e-3, 9e-3, 14e-3):
        axes = (size, size / 1.5)
        corner = np.array(axes)
        share.append(
            PressureFilm(1.27e-3).read(hertz_field(axes, 1.0), -corner, corner).perimeter_share
        )
        area.append(worst_errors(axes, 1.27e-3, places=8)["area"])
    assert (np.diff(share) < 0.0).all()
    assert np.corrcoef(np.log(share), np.log(area))[0, 1] > 0.9
