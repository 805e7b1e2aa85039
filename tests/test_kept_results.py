"""Stored results of an interrupted study: read back equal, ignored or refused when damaged."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.run.recorder import Shard, Shards
from tkamb.studies.cohort.outcome import Outcome, PressureMap
from tkamb.studies.kept_rows import FILE_NAME, KeptRows
from tkamb.studies.measures import Measure

COLUMNS = {"time_s": np.arange(3.0), "flexion_deg": np.array([1.0, np.nan, 3.0])}
MAP = PressureMap(1, np.eye(3), np.array([[0, 1, 2]]), np.ones(3), "left", "medial")
OUTCOME = Outcome("", COLUMNS, ["ok"] * 3, MAP, {"max": 1.0})


def test_a_stored_outcome_is_read_back(tmp_path):
    shards = Shards(tmp_path, {"cohort": "a"}, resume=False)
    for n, outcome in enumerate((OUTCOME, replace(OUTCOME, chosen=None), Outcome("no", {}, []))):
        shards.put(n, outcome.shard())
        again = Outcome.of(shards.get(n))
        assert (again.reason, again.status, again.wear) == (
            outcome.reason,
            outcome.status,
            outcome.wear,
        )
        for name, values in outcome.columns.items():
            np.testing.assert_array_equal(again.columns[name], values)
    path = tmp_path / ".frames" / "000000.frame"
    path.write_bytes(path.read_bytes()[:-1])
    assert shards.get(0) is None
    assert Shards(tmp_path, {"cohort": "a"}, resume=True).resumed
    with pytest.raises(InputError, match="another cohort"):
        Shards(tmp_path, {"cohort": "b"}, resume=True)


def test_a_pickled_object_is_never_loaded(tmp_path):
    """Unpickling runs code."""
    shards = Shards(tmp_path, {}, resume=False)
    shards.put(0, Shard({}, {"x": np.array([print], dtype=object)}))
    with pytest.raises(InputError, match="is damaged"):
        shards.get(0)


MEASURE = Measure("ok", 1.0, 2.0, 3.0, float("nan"), 5, 6, {"approach": 1e-4}, {"1 -2": 3e6})


def test_a_row_of_a_study_is_read_back_and_a_cut_one_counts_as_absent(tmp_path):
    rows = KeptRows(tmp_path, False)
    rows.put("a", asdict(MEASURE))
    rows.put("b", asdict(Measure("stopped after 300 s")))
    path = tmp_path / FILE_NAME
    path.write_text(path.read_text()[:-20])
    again = KeptRows(tmp_path, True)
    assert repr(again.read("a", Measure)) == repr(MEASURE)
    assert again.read("b", Measure) is None
    rows.put("a", {"status": 1})
    with pytest.raises(InputError, match=r"rows\.jsonl: is damaged"):
        KeptRows(tmp_path, True).read("a", Measure)


def test_a_study_is_resumed_from_its_rows(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("tkamb.studies.tradeoff.QUICK_MODELS", ("hertz",))
    measured = []
    measure = replace(MEASURE, values={"approach": 1e-4} | {
        f"{side}_{part}": 1.0 for side in ("medial", "lateral")
        for part in ("force", "mean_pressure", "peak_pressure", "area")})  # fmt: skip
    monkeypatch.setattr(
        "tkamb.studies.tradeoff.measure_apart", lambda job: measured.append(job) or measure
    )
    command = ["tradeoff", "--quick", "--out", str(tmp_path / "out")]
    assert main(command) == 0 and measured
    count = len(measured)
    assert main([*command, "--resume"]) == 0 and len(measured) == count
    path = tmp_path / "out" / FILE_NAME
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:-1]) + "\n" + json.dumps({"key": "x"}) + "\n")
    assert main([*command, "--resume"]) == 0 and len(measured) == count + 1
    assert "rows.jsonl" not in capsys.readouterr().err
