"""Stored results of an interrupted study are checked before use: names, types and shapes."""

import io
import json
import zipfile
from dataclasses import asdict, replace

import numpy as np
import pytest

from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.run.recorder import Shard, Shards, have, read_arrays
from tkamb.studies.cohort.outcome import Outcome, PressureMap, is_outcome
from tkamb.studies.extremes import Extreme
from tkamb.studies.kept_rows import FILE_NAME, KeptRows, _line
from tkamb.studies.measures import Measure, is_whole
from tkamb.studies.stability import run_stability
from tkamb.studies.tradeoff import Job, run_tradeoff
from tkamb.studies.wear.bands import BANDED, _is_sample

NAN, HUGE = float("nan"), 10**400
COLUMNS = {
    "time_s": np.arange(3.0),
    "flexion_deg": np.array([1.0, NAN, 3.0]),
    "iterations": np.arange(3),
}
MAP = PressureMap(1, np.eye(3), np.array([[0, 1, 2]]), np.ones(3), "left", "medial")
OUTCOME = Outcome("", COLUMNS, ["ok"] * 3, MAP, {"max": 1.0})


def test_a_stored_outcome_is_read_back():
    for outcome in (OUTCOME, replace(OUTCOME, chosen=None), Outcome("no file", {}, [])):
        shard = outcome.shard()
        assert is_outcome(Shard(json.loads(json.dumps(shard.row)), shard.contact))
        assert Outcome.of(shard).status == outcome.status


@pytest.mark.parametrize(
    "row",
    [
        {"status": ["ok"]},
        {"status": [1, 2, 3]},
        {"status": "ok"},
        {"reason": None},
        {"reason": "a reason, and columns"},
        {"wear": {"max": "1"}},
        {"wear": [1.0]},
        {"wear_problem": 1},
        {"frame": 3},
        {"frame": -1},
        {"frame": 0.5},
        {"frame": HUGE},
        {"side": "../x"},
        {"lateral": "up"},
        {"other": 1},
    ],
)
def test_an_outcome_with_an_invalid_row_is_refused(row):
    shard = OUTCOME.shard()
    assert not is_outcome(Shard({**shard.row, **row}, shard.contact))
    for name in row.keys() & shard.row.keys():
        assert not is_outcome(
            Shard({k: v for k, v in shard.row.items() if k != name}, shard.contact)
        )


@pytest.mark.parametrize(
    "arrays",
    [
        {"column time_s": np.arange(4.0)},
        {"column time_s": np.array([0.0, NAN, 1.0])},
        {"column time_s": np.zeros((3, 1))},
        {"column time_s": np.array(["0", "1", "2"])},
        {"column x": np.zeros(3, complex)},
        {"points": np.zeros((3, 2))},
        {"points": np.full((3, 3), NAN)},
        {"points": np.zeros(3)},
        {"pressure": np.array([1.0, np.inf, 1.0])},
        {"pressure": np.ones(4)},
        {"triangles": np.array([[0, 1, 3]])},
        {"triangles": np.array([[0, 1, -1]])},
        {"triangles": np.array([[0.0, 1.0, 2.0]])},
        {"other": np.zeros(3)},
    ],
)
def test_an_outcome_with_invalid_arrays_is_refused(arrays):
    shard = OUTCOME.shard()
    assert not is_outcome(Shard(shard.row, {**shard.contact, **arrays}))


SAMPLE = {name: np.arange(4.0) for name in ("cycles", *BANDED)}


@pytest.mark.parametrize(
    "changed",
    [
        {"cycles": np.arange(3.0)},
        {"cycles": np.array([0.0, 2.0, 1.0, 3.0])},
        {"cycles": np.array([0.0, NAN, 1.0, 3.0])},
        {"cycles": np.array(1.0)},
        {"volume_mm3": np.full(4, NAN)},
        {"volume_mm3": np.arange(4)},
        {"mass_mg": np.zeros((4, 1))},
        {"more": np.arange(4.0)},
        dict.fromkeys(SAMPLE, np.zeros(0)),
    ],
)
def test_a_wear_sample_with_invalid_columns_is_refused(changed):
    assert _is_sample(Shard({}, SAMPLE)) and _is_sample(Shard({}, None))
    assert not _is_sample(Shard({}, SAMPLE | changed))
    assert not _is_sample(
        Shard({}, {k: v for k, v in SAMPLE.items() if k not in changed} | {"x": 1})
    )


def test_arrays_of_gigabytes_are_not_unpacked():
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("x.npy", b"")
    content = bytearray(packed.getvalue())
    offset = content.rindex(b"PK\x01\x02") + 24  # offset of the uncompressed size
    content[offset : offset + 4] = (3 * 10**9).to_bytes(4, "little")
    with pytest.raises(ValueError, match="too large"):
        read_arrays(bytes(content))
    assert not have({"a": np.zeros(3)}, {"a": ("f", (3, 1))})


def test_a_forged_shard_with_a_valid_digest_is_an_input_error(tmp_path):
    shards = Shards(tmp_path, {"cohort": "a"}, resume=False)
    shards.put(0, OUTCOME.shard())
    shards.put(1, Shard({}, {"x": np.zeros(2)}))
    assert Outcome.of(shards.get(0, is_outcome)).wear == {"max": 1.0}
    for check in (is_outcome, _is_sample):
        with pytest.raises(InputError, match=r"000001.*somebody changed it.*; remove it"):
            shards.get(1, check)
    path = tmp_path / ".frames" / "000000.frame"
    path.write_bytes(path.read_bytes()[:-1])
    assert shards.get(0, is_outcome) is None
    assert Shards(tmp_path, {"cohort": "a"}, resume=True).resumed
    with pytest.raises(InputError, match="another cohort"):
        Shards(tmp_path, {"cohort": "b"}, resume=True)


MEASURE = Measure(
    "ok", 1.0, 2.0, 3.0, 4.0, 5, 6,
    {"approach": 1e-4} | {f"{side}_{part}": 1.0 for side in ("medial", "lateral")
                          for part in ("force", "mean_pressure", "peak_pressure", "area")},
    {"1 -2": 3e6},
)  # fmt: skip


@pytest.mark.parametrize(
    "changed",
    [
        {"status": 1},
        {"warm_seconds": "1"},
        {"warm_seconds": None},
        {"iterations": 1.5},
        {"nodes": HUGE},
        {"values": {}},
        {"values": [1.0]},
        {"values": {**MEASURE.values, "approach": NAN}},
        {"values": {**MEASURE.values, "approach": "1"}},
        {"map": {"1": 3e6}},
        {"map": {"1 2 3": 3e6}},
        {"map": {"a b": 3e6}},
        {"map": {"1 2": None}},
        {"other": 1},
    ],
)
def test_a_forged_row_of_a_study_is_an_input_error(tmp_path, changed):
    rows = KeptRows(tmp_path, False)
    rows.put("a", asdict(MEASURE))
    assert KeptRows(tmp_path, True).read("a", Measure, is_whole) == MEASURE
    rows.put("a", asdict(MEASURE) | changed)
    with pytest.raises(InputError, match=r"rows\.jsonl.*not a Measure.*; remove the file"):
        KeptRows(tmp_path, True).read("a", Measure, is_whole)
    name = next(iter(changed.keys() & asdict(MEASURE).keys()), "status")
    rows.put("a", {key: value for key, value in asdict(MEASURE).items() if key != name})
    with pytest.raises(InputError, match="not a Measure"):
        KeptRows(tmp_path, True).read("a", Measure, is_whole)


def test_a_stopped_measure_is_stored(tmp_path):
    rows = KeptRows(tmp_path, False)
    rows.put("a", asdict(Measure("stopped after 300 s")))
    assert KeptRows(tmp_path, True).read("a", Measure, is_whole).status == "stopped after 300 s"


def forge_rows(folder):
    """Remove the iterations from every stored row and update the SHA-256."""
    path = folder / FILE_NAME
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    for row in rows:
        row["row"].pop("iterations")
    path.write_text("".join(_line(row["key"], row["row"]) for row in rows))


def test_studies_refuse_a_forged_row(tmp_path, monkeypatch):
    cases = [Extreme(model="nothing")]
    assert list(run_stability(cases, kept=KeptRows(tmp_path, False)))
    forge_rows(tmp_path)
    with pytest.raises(InputError, match="not a Verdict"):
        list(run_stability(cases, kept=KeptRows(tmp_path, True)))
    monkeypatch.setattr("tkamb.studies.tradeoff.measure_apart", lambda job: MEASURE)
    references = {"sphere": _reference()}
    jobs = [Job("sphere", "hertz", 2.0)]
    assert list(run_tradeoff(jobs, references, KeptRows(tmp_path, False)))
    forge_rows(tmp_path)
    with pytest.raises(InputError, match="not a Measure"):
        list(run_tradeoff(jobs, references, KeptRows(tmp_path, True)))


def _reference():
    from tkamb.studies.references import read_references

    return read_references()["sphere"]


def test_a_forged_row_ends_the_command_with_status_2(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("tkamb.studies.tradeoff.QUICK_MODELS", ("hertz",))
    out = ["tradeoff", "--quick", "--out", str(tmp_path / "out")]
    monkeypatch.setattr("tkamb.studies.tradeoff.measure_apart", lambda job: MEASURE)
    assert main(out) == 0
    forge_rows(tmp_path / "out")
    capsys.readouterr()
    assert main([*out, "--resume"]) == 2
    message = capsys.readouterr().err.strip()
    assert "\n" not in message and "rows.jsonl" in message and "--resume" in message
