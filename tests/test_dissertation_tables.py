"""Tables D-1 to D-12 are complete, and each error found in them is computed again."""

import numpy as np
import pytest

from tkamb.errors import InputError
from validation import dissertation as d

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
