"""The stability study: its verdicts, its processes, and a sample of its cases."""

import json
import multiprocessing
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tkamb.cli import main
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus
from tkamb.show.study_figures import picture
from tkamb.studies import stability
from tkamb.studies.cases import Extreme, extremes
from tkamb.studies.kept_rows import KeptRows, row_key
from tkamb.studies.stability import (
    SceneExtreme,
    _Judges,
    judge_safely,
    judge_scene,
    kept_verdicts,
    run_stability,
    scene_extremes,
    stability_cases,
    stored_verdicts,
    summary,
    table,
)
from tkamb.studies.verdict import KINDS, PASSED_KINDS, Verdict, compared, judge

ROOT = Path(__file__).parents[1]
SMALL = Extreme(resolution_mm=3.0)


def test_the_study_varies_every_parameter():
    cases = list(extremes())
    assert len(cases) >= 300 and len(set(cases)) == len(cases)
    varied = {
        name for case in cases for name in vars(case) if vars(case)[name] != vars(Extreme())[name]
    }
    assert varied == set(vars(Extreme()))
    assert 10 * len(stability_cases(quick=True)) >= len(cases)


def test_every_quick_case_has_a_stored_verdict():
    stored = stored_verdicts()
    assert set(stored.values()) <= set(PASSED_KINDS)
    quick = {f"{case.model}: {case.label}" for case in stability_cases(quick=True)}
    assert not quick - set(stored)


@pytest.mark.parametrize(("kind", "expected", "fails"), [
    ("converged", "converged", False),
    ("converged", "flagged", False),
    ("flagged", "flagged", False),
    ("flagged", None, False),
    ("flagged", "converged", True),
    ("unflagged_wrong", "flagged", True),
])  # fmt: skip
def test_a_flag_fails_if_the_stored_verdict_is_converged(kind, expected, fails):
    verdict = Verdict("a case", "lattice", kind, "why", expected=expected)
    assert verdict.failed is fails
    counts = summary([verdict])
    assert counts["failed"] == fails
    assert counts["worse"] == (fails and kind == "flagged")
    printed = "\n".join(table([verdict])).split("failed: ")[1]
    assert printed.startswith("1" if fails else "0")


def test_a_usual_case_agrees_with_newton():
    verdict = judge(SMALL)
    assert verdict.kind == "converged" and "not converged" not in verdict.reason
    assert verdict.error < 2e-3


def test_an_excessive_load_is_flagged_with_a_reason():
    verdict = judge(replace(SMALL, load_N=1e5))
    assert verdict.kind == "flagged" and len(verdict.reason) > 20


def test_a_femur_beside_the_insert_is_flagged():
    verdict = judge(replace(SMALL, ml_mm=300.0))
    assert verdict.kind == "flagged" and "does not lie over" in verdict.reason


def test_an_impossible_material_is_flagged():
    assert judge(replace(SMALL, nu=0.7)).kind == "flagged"


@pytest.mark.parametrize(("share", "flags", "kind"), [
    (1.0, (), "converged"),
    (1.03, (), "unflagged_wrong"),
    (1.03, ("a reason",), "flagged"),
    (np.nan, (), "unflagged_wrong"),
])  # fmt: skip
def test_a_wrong_result_without_a_flag_is_unflagged_wrong(share, flags, kind):
    model = contact_model("foundation", resolution=3e-3)
    result = model.press(model.prepare(SMALL.pair), 100.0, SMALL.pose)
    assert result.status is ContactStatus.OK
    pose = SMALL.pair.pose_at_approach(result.pose, share * result.approach)
    other = replace(result, pose=pose, flags=flags)
    assert compared(SMALL, other, result, 0.0).kind == kind


def test_an_exception_is_a_verdict():
    verdict = judge_safely(replace(SMALL, model="no such model"))
    assert verdict.kind == "flagged"
    verdict = judge_safely(replace(SMALL, facet_deg=0.0))
    assert verdict.kind == "exception" and "Error" in verdict.reason


def test_a_hang_is_stopped_and_the_next_case_judged(monkeypatch):
    """The limits are processor times, so that the load of the computer has no effect."""
    slow, quick = replace(SMALL, resolution_mm=0.5), replace(SMALL, model="nothing")
    monkeypatch.setattr(_Judges, "limit", lambda self, case: 0.1 if case is slow else 600.0)
    verdicts = list(run_stability([slow, quick]))
    assert [v.kind for v in verdicts] == ["hang", "flagged"]


def test_a_case_that_only_waits_is_no_hang(monkeypatch):
    """On a loaded computer a process waits. The limit counts its own computing time alone."""
    waited = Verdict("a case", "lattice", "converged", "after a wait longer than the limit")
    monkeypatch.setattr(stability, "judge_safely", lambda *_: time.sleep(0.5) or waited)
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=stability._send_verdict, args=(SMALL, sender, 0.2, 0.2))
    process.start()
    sender.close()
    assert receiver.recv() == waited
    process.join()


def test_a_reference_that_takes_too_long_leaves_a_case_unverified(monkeypatch):
    monkeypatch.setattr(stability, "LONGEST_REFERENCE_SECONDS", 0.5)
    slow = Extreme(load_N=20000.0, conformity=0.99)
    (verdict,) = run_stability([slow])
    assert verdict.kind == "unverified" and "no reference in 0.5 s" in verdict.reason


def test_counts_add_up_and_failures_are_listed():
    verdicts = [Verdict(f"load_N={k}", "lattice", kind, "why", 0.1) for k, kind in enumerate(KINDS)]
    counts = summary(verdicts)
    kinds = ("converged", "flagged", "unflagged_wrong", "unverified", "exceptions", "hangs")
    assert [counts[kind] for kind in kinds] == [1] * 6
    assert counts["cases"] == len(counts["rows"]) == 6
    text = "\n".join(table(verdicts))
    assert all(kind in text for kind in KINDS)
    assert picture(verdicts).axes


def test_a_quarter_of_the_quick_study_has_no_failure():
    verdicts = list(run_stability(stability_cases(quick=True)[::4]))
    assert not [v for v in verdicts if v.failed]
    assert all(v.reason for v in verdicts if v.kind == "flagged")
    assert Counter(v.kind for v in verdicts)["converged"] > 0.7 * len(verdicts)


def test_a_thin_insert_of_coarse_cells_is_refused_for_its_volume():
    thin = [case for case in stability_cases(quick=True) if "thickness_mm=0.5" in case.label]
    (verdict,) = run_stability(thin)
    assert verdict.kind == "flagged" and not verdict.failed
    assert "less volume than the mesh" in verdict.reason


def test_stored_verdicts_are_not_computed_again(tmp_path):
    kept = KeptRows(tmp_path, resume=False)
    cases = [replace(SMALL, model="foundation"), replace(SMALL, model="nothing")]
    first = list(run_stability(cases, kept=kept))
    with open(kept.path, "a", encoding="utf-8") as file:
        file.write('{"key": "an incomplete li')
    again = KeptRows(tmp_path, resume=True)
    assert list(run_stability(cases, longest=120.0, kept=again)) == first
    assert kept_verdicts(cases, again) == first
    assert len(again.path.read_text().splitlines()) == 2
    other = list(run_stability([replace(cases[0], load_N=1400.0)], kept=again))
    assert other[0] not in first and len(again.path.read_text().splitlines()) == 3
    assert not KeptRows(tmp_path, resume=False).path.read_text()


def test_the_key_of_a_row_depends_on_case_and_code(monkeypatch):
    key = row_key("stability", {"load_N": 1.0})
    assert key == row_key("stability", {"load_N": 1.0})
    assert key != row_key("stability", {"load_N": 2.0})
    monkeypatch.setattr("tkamb.studies.kept_rows.code_identity", lambda: "other code")
    assert key != row_key("stability", {"load_N": 1.0})


def test_an_interrupted_study_writes_the_finished_cases(tmp_path):
    command = [sys.executable, "-m", "tkamb.cli", "stability", "--quick", "--out", str(tmp_path)]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, cwd=ROOT, stdout=pipe, stderr=pipe, text=True)
    rows = tmp_path / "rows.jsonl"
    while process.poll() is None and not (rows.exists() and rows.read_text().count("\n") > 1):
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    output, message = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "--resume" in message and "Traceback" not in message
    assert output.startswith("stopped: ")
    written = json.loads((tmp_path / "stability.json").read_text())
    assert 2 <= written["cases"] < len(stability_cases(quick=True))
    assert (tmp_path / "stability.png").exists()


@pytest.mark.slow
def test_inertia_forces_scale_with_the_square_of_the_speed():
    assert judge_scene(SceneExtreme("time", 3.0)).kind == "converged"


@pytest.mark.slow
def test_the_full_study_has_no_wrong_result(tmp_path, capsys):
    status = main(["stability", "--json", "--out", str(tmp_path)])
    study = json.loads(capsys.readouterr().out)
    assert study["cases"] >= 300
    for kind in ("unflagged_wrong", "exceptions", "hangs"):
        assert study[kind] == 0, [row for row in study["rows"] if row["kind"] not in KINDS[:2]]
    assert status == (1 if study["unverified"] else 0)
    assert all(row["reason"] for row in study["rows"] if row["kind"] == "flagged")
    assert (tmp_path / "stability.png").stat().st_size > 10_000
    assert len(list(scene_extremes())) > 20
