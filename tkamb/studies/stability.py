"""Stability at the extremes: every case judged in a process that may crash or hang."""

import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from tkamb.errors import ComputationError, TkambError
from tkamb.studies.closed_forms import ClosedForm, closed_forms
from tkamb.studies.extremes import Extreme, Shape, beside_calculix, extremes
from tkamb.studies.kept_rows import KeptRows, row_key
from tkamb.studies.measures import ONE_THREAD
from tkamb.studies.scene_extremes import SceneExtreme, judge_scene, scene_extremes
from tkamb.studies.verdict import KINDS, Verdict, judge, judge_closed_form

Case = Extreme | ClosedForm | SceneExtreme

STORED = Path(__file__).with_name("verdicts.json")
"""Verdict on each case, as last accepted; `scripts/make_stability_verdicts` writes it."""

LONGEST_SECONDS = 120.0
"""A case whose model takes longer hangs."""
LONGEST_REFERENCE_SECONDS = 900.0
"""A case whose reference takes longer is unverified."""
PRESSED = "pressed"
"""What a process says once the model has answered."""
WORKERS = 2
QUICK_SHARE = 13
QUICK_GRID_MM = 3.0
QUICK_SHAPES: tuple[Shape, ...] = ("swapped", "lip", "spike")
QUICK_PEERED = 4
"""The quick study takes one extreme in so many, no finer than this; unusual shapes; the first
cases beside CalculiX; the first closed forms; no runs."""


def stability_cases(quick: bool) -> list[Case]:
    """Return the cases of the study."""
    if not quick:
        return [*closed_forms(False), *extremes(), *scene_extremes()]
    coarse = (replace(c, resolution_mm=max(c.resolution_mm, QUICK_GRID_MM)) for c in extremes())
    some = [*dict.fromkeys(coarse)][::QUICK_SHARE]
    shapes = [Extreme(resolution_mm=QUICK_GRID_MM, shape=shape) for shape in QUICK_SHAPES]
    peered = list(beside_calculix())[:QUICK_PEERED]
    return [*closed_forms(True), *dict.fromkeys((*peered, *shapes, *some))]


def stored_verdicts(path: Path = STORED) -> dict[str, str]:
    """Return case -> kind as last accepted; nothing if there is no file."""
    if not path.exists():
        return {}
    content: dict[str, str] = json.loads(path.read_text(encoding="utf-8"))
    return content


def run_stability(
    cases: Sequence[Case],
    longest: float = LONGEST_SECONDS,
    kept: KeptRows | None = None,
    workers: int = WORKERS,
) -> Iterator[Verdict]:
    """Judge all cases; yield their verdicts in order.

    Args:
        cases: the cases.
        longest: s, after which a case counts as hanging.
        kept: rows of an earlier study that are taken as they are; new ones are added.
        workers: cases at a time.
    """
    asked, stored = _Asked(longest, kept), stored_verdicts()
    pool = ThreadPoolExecutor(workers)
    try:
        for verdict in pool.map(asked.verdict, cases):
            yield replace(verdict, expected=stored.get(verdict.key))
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        asked.stop()
        pool.shutdown()


class _Asked:
    """Cases put to the processes that judge, one process for each thread."""

    def __init__(self, longest: float, kept: KeptRows | None) -> None:
        self._longest, self._kept = longest, kept
        self._local = threading.local()
        self._workers: list[_Worker] = []

    def verdict(self, case: Case) -> Verdict:
        """Return the verdict on a case, kept or new."""
        if self._kept is None:
            return self._worker().ask(case)
        key = row_key(type(case).__name__, asdict(case), self._longest)
        row = self._kept.get(key)
        if row is not None:
            return Verdict(**row)
        found = self._worker().ask(case)
        self._kept.put(key, found.as_dict())
        return found

    def stop(self) -> None:
        """End the processes."""
        for worker in self._workers:
            worker.stop()

    def _worker(self) -> "_Worker":
        if not hasattr(self._local, "worker"):
            self._local.worker = _Worker(self._longest)
            self._workers.append(self._local.worker)
        found: _Worker = self._local.worker
        return found


class _Worker:
    """A process that judges one case after the other, and is replaced when it does not answer."""

    def __init__(self, longest: float) -> None:
        self._longest = longest
        self._process: subprocess.Popen[str] | None = None
        self._lines: queue.Queue[str] = queue.Queue()
        self._stopped = False

    def ask(self, case: Case) -> Verdict:
        """Return the verdict on a case.

        Raises:
            ComputationError: the study was stopped meanwhile.
        """
        process = self._process or self._started()
        assert process.stdin is not None
        process.stdin.write(json.dumps([type(case).__name__, asdict(case)]) + "\n")
        process.stdin.flush()
        kind, limit = "hang", self._longest
        try:
            line = self._lines.get(timeout=limit)
            if line.strip() == PRESSED:
                kind, limit = "unverified", LONGEST_REFERENCE_SECONDS
                line = self._lines.get(timeout=limit)
        except queue.Empty:
            self._end()
            what = "no answer" if kind == "hang" else "no reference"
            return _ended(case, kind, f"{what} in {limit:g} s")
        if self._stopped:
            raise ComputationError("was stopped", case.says)
        if not line:
            status = process.wait()
            self._end()
            return _ended(case, "exception", f"the process ended with status {status}")
        return Verdict(**json.loads(line))

    def stop(self) -> None:
        """End the process for good; a case that is being judged gets no verdict."""
        self._stopped = True
        if self._process is not None:
            self._process.kill()

    def _end(self) -> None:
        """End the process; the next case gets a new one."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
        self._process = None

    def _started(self) -> "subprocess.Popen[str]":
        command = [sys.executable, "-m", "tkamb.studies.stability"]
        pipe = subprocess.PIPE
        process = subprocess.Popen(
            command,
            stdin=pipe,
            stdout=pipe,
            text=True,
            start_new_session=True,
            env=os.environ | ONE_THREAD,
        )
        lines: queue.Queue[str] = queue.Queue()
        self._process, self._lines = process, lines

        def read() -> None:
            assert process.stdout is not None
            for line in iter(process.stdout.readline, ""):
                lines.put(line)
            lines.put("")

        threading.Thread(target=read, daemon=True).start()
        return process


def _ended(case: Case, kind: str, reason: str) -> Verdict:
    return Verdict(case.says, getattr(case, "model", "run"), kind, reason)


def judge_safely(case: Case, pressed: Callable[[], None] = lambda: None) -> Verdict:
    """Return the verdict on a case; an exception that is no clean error is a verdict too."""
    try:
        if isinstance(case, Extreme):
            return judge(case, pressed)
        if isinstance(case, ClosedForm):
            return judge_closed_form(case, pressed)
        return judge_scene(case)
    except TkambError as error:
        return _ended(case, "flagged", str(error))
    except Exception as error:
        return _ended(case, "exception", f"{type(error).__name__}: {error}")


def summary(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """Return what `tkamb stability --json` prints."""
    counts = {kind: sum(v.kind == kind for v in verdicts) for kind in KINDS}
    return {
        "cases": len(verdicts),
        "converged": counts["converged"],
        "flagged": counts["flagged"],
        "unflagged_wrong": counts["unflagged_wrong"],
        "unverified": counts["unverified"],
        "exceptions": counts["exception"],
        "hangs": counts["hang"],
        "worse": sum(verdict.worse for verdict in verdicts),
        "failed": sum(verdict.failed for verdict in verdicts),
        "rows": [verdict.as_dict() for verdict in verdicts],
    }


def _answers() -> Iterator[Verdict]:
    kinds = {kind.__name__: kind for kind in (Extreme, ClosedForm, SceneExtreme)}
    for line in sys.stdin:
        kind, fields = json.loads(line)
        yield judge_safely(kinds[kind](**fields), lambda: print(PRESSED, flush=True))


if __name__ == "__main__":
    for verdict in _answers():
        print(json.dumps(verdict.as_dict()), flush=True)
