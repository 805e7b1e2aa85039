"""Claims of the outputs: no sentence contradicts docs/truth.md or the run itself."""

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scenes import MODEL
from tkamb.run import metrics
from tkamb.run.claims import FORCES, measured_trials, method_error, peaks_of, split_of
from tkamb.run.simulation import simulate
from tkamb.show.axis import horizontal_axis
from tkamb.show.headline import cards, peak_lines
from tkamb.show.report import report_html
from tkamb.show.sections import conclusions, lead, methods, motion_table
from tkamb.show.view.draw import readings

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = sorted(ROOT.glob("models/deep_knee_bend/scene.toml")) + sorted(
    path for name in ("dm", "jw") for path in (ROOT / "models" / name).glob("*.toml")
)
NEWTONS_PER_BW = 66.7 * 9.80665


Truth = dict[tuple[str, bool], dict[str, list[float]]]


def numbers_of(text: str) -> list[float]:
    return [float(n) for n in re.findall(r"[-+]?\d+(?:\.\d+)?", text)]


def truth_rows() -> Truth:
    """Return (trial, whether it has all muscles) -> force -> numbers, from truth.md."""
    text = (ROOT / "docs" / "truth.md").read_text(encoding="utf-8")
    rows, trial = Truth(), ""
    for line in text.split("**With the quadriceps")[0].splitlines():
        if match := re.match(r"\| (og1|og3|squat)?[^|]*\| (total|medial|lateral) \|(.*)", line):
            trial = match[1] or trial
            rows.setdefault((trial, True), {})[match[2]] = numbers_of(match[3])
    second = text.split("**With the quadriceps as the only muscle**")[1].split("**Beside")[0]
    for line in second.splitlines():
        if match := re.match(r"\| (og1|og3|squat)\b[^|]*\|(.*)", line):
            rmse, bias, _, peak, measured, medial, lateral, *_ = numbers_of(match[2])
            rows[match[1], False] = {
                "total": [rmse, bias, 0.0, peak, measured],
                "medial": [medial / NEWTONS_PER_BW],
                "lateral": [lateral / NEWTONS_PER_BW],
            }
    return rows


def test_the_measured_errors_are_those_of_the_page_on_truth():
    rows = truth_rows()
    assert len(rows) == len(measured_trials()) == 6
    for (trial, muscles), forces in rows.items():
        (one,) = (t for t in measured_trials() if t.trial.endswith(trial) and t.muscles is muscles)
        rmse, bias, _, peak, measured_peak = forces["total"]
        assert [one.rmse_BW["total"], one.bias_BW] == [rmse, bias]
        assert [one.peak_BW, one.measured_peak_BW] == [peak, measured_peak]
        for side in ("medial", "lateral"):
            assert one.rmse_BW[side] == pytest.approx(forces[side][0], abs=0.006)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_the_error_of_a_shipped_scene_has_the_sign_that_was_measured(path, shipped):
    """The words of report and Methods, for the activity and the muscles of the scene."""
    scene = tomllib.loads(path.read_text(encoding="utf-8"))
    if "base" in scene:
        base = tomllib.loads((path.parent / scene["base"]).read_text(encoding="utf-8"))
        scene = base | scene | {"output": base.get("output", {}) | scene.get("output", {})}
    activity, muscles = scene.get("output", {}).get("activity"), "muscles" in scene
    tables = dict(shipped.summary["scene_tables"])
    tables |= {"muscles": MUSCLES} if muscles else {}
    summary = shipped.summary | {"activity": activity, "scene_tables": tables}
    run = replace(shipped, summary=summary)
    texts = [*conclusions(run)[0], *conclusions(run)[1], *methods(summary).sentences]
    texts += [text for _, text in lead(run, horizontal_axis(run))]
    texts += scene.get("output", {}).get("notes", [])
    every = " ".join(texts)
    assert "lower bound" not in every and "force is too low" not in every
    measured = [t for t in measured_trials() if t.activity == activity and t.muscles is muscles]
    error = method_error(summary)
    assert list(error.trials if error.same_activity else ()) == measured
    if not measured:
        assert "was not compared with measured forces" in every
        assert not any("The total force, with the error" in one for one in conclusions(run)[0])
    else:
        (direction,) = {"too high" if t.bias_BW > 0 else "too low" for t in measured if t.bias_BW}
        assert {*re.findall("too high|too low", every)} == {direction}
        computed = [f"{t.peak_BW:.2f}" for t in measured]
        peaks = [f"{t.measured_peak_BW:.2f}" for t in measured]
        how_wrong = dict(lead(run, horizontal_axis(run)))["How wrong they may be"]
        for numbers in (computed, peaks):
            assert f" {' and '.join(numbers)} BW" in how_wrong


MUSCLES = {
    "weights": "volume",
    "exponent": 2.0,
    "least_activation": 0.0,
    "law": "isometric",
    "reserve_Nm": 10.0,
}


@pytest.fixture(scope="module")
def shipped():
    return simulate(MODEL / "scene.toml", frames=slice(0, 101, 50), contact="foundation")


def test_every_output_leads_with_the_split_that_the_conclusions_allow(shipped):
    """Adduction of the shipped knee is recorded and does not determine the split."""
    assert split_of(shipped.columns).estimate == "equilibrium"
    weight = metrics.body_weight(shipped)
    peaks = {side: shipped[f"{side}_force_equilibrium_N"].max() / weight for side in FORCES[1:]}
    other = {side: shipped[f"{side}_force_N"].max() / weight for side in FORCES[1:]}
    for side, force in peaks.items():
        assert abs(force - other[side]) > 0.005
        assert peaks_of(shipped)[side]["nominal"] == pytest.approx(force)
        assert shipped.summary["peaks_BW"][side]["nominal"] == pytest.approx(force)
        for text in (
            cards(shipped, horizontal_axis(shipped))[0].value,
            lead(shipped, horizontal_axis(shipped))[0][1],
            "; ".join(peak_lines(shipped)),
        ):
            assert re.search(rf"{side}(?: force:)? {force:.2f}", text)
    supported, unsupported = conclusions(shipped)
    error = method_error(shipped.summary)
    errors = [f"{side} {error.rmse(side):.2f}" for side in FORCES[1:]]
    share = "The share of each condyle, by equilibrium of moments"
    assert f"{share}, with the errors of squat: {', '.join(errors)} BW (rms)." in supported
    table = motion_table(shipped, horizontal_axis(shipped))
    for side in FORCES[1:]:
        place = table.headings.index((side, "N, equil."))
        cells = [float(row[place]) for row in table.rows]
        assert max(cells) == round(peaks[side] * weight)
    assert any(one.startswith("The split by deformation in any frame") for one in unsupported)
    names = [row.name for row in readings(shipped, horizontal_axis(shipped))]
    assert names.index("· by equilibrium") < names.index("· by deformation")
    doubted = {row.name: row.values for row in readings(shipped, horizontal_axis(shipped))}
    assert all(value.endswith("?") for value in doubted["· by deformation"])


def test_a_peak_at_which_the_estimates_differ_is_not_stated(shipped):
    columns = dict(shipped.columns) | {"split_determined": np.ones(len(shipped))}
    medial, lateral = columns["medial_force_N"], columns["lateral_force_N"]
    total = medial + lateral
    columns |= {"medial_force_N": 0.9 * total, "lateral_force_N": 0.1 * total}
    run = replace(shipped, columns=columns)
    assert [one["supported"] for one in peaks_of(run).values()] == [True, False, False]
    card = cards(run, horizontal_axis(run))[0]
    assert "medial" not in card.value and "two estimates differ" in card.sentence and card.warning
    assert "medial" not in lead(run, horizontal_axis(run))[0][1].split(".  ")[0].split(";")[0]
    assert "split in any frame" in " ".join(conclusions(run)[1])


def test_each_tile_shows_one_sentence_and_unfolds_the_others(shipped):
    for card in cards(shipped, horizontal_axis(shipped)):
        assert not re.search(r"[a-z]\. [A-Z]", card.sentence)
    page = report_html(shipped)
    assert page.count("<details><summary>details") == sum(
        bool(card.more) for card in cards(shipped, horizontal_axis(shipped))
    )
    assert page.index("Peak forces") < page.index("How wrong they may be")
    assert page.index("How wrong they may be") < page.index("What not to conclude")
