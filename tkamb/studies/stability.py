"""Stability at the extremes: every case judged in a process that may crash or hang."""

import json
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import Any

from tkamb.errors import TkambError
from tkamb.studies.extremes import Extreme, extremes
from tkamb.studies.scene_extremes import SceneExtreme, judge_scene, scene_extremes
from tkamb.studies.verdict import KINDS, Verdict, judge

Case = Extreme | SceneExtreme
Progress = Callable[[Iterable[Verdict], int], Iterable[Verdict]]

LONGEST_SECONDS = 120.0
"""A case that takes longer hangs."""
WORKERS = 2
QUICK_SHARE = 10
"""The quick study takes one contact case in so many, and no runs."""
FAILED_KINDS = ("unflagged_wrong", "unverified", "exception", "hang")


def stability_cases(quick: bool) -> list[Case]:
    """Return the cases of the study."""
    pressed: list[Case] = list(extremes())
    return pressed[::QUICK_SHARE] if quick else [*pressed, *scene_extremes()]


def run_stability(
    cases: Sequence[Case],
    progress: Progress = lambda verdicts, total: verdicts,
    longest: float = LONGEST_SECONDS,
) -> list[Verdict]:
    """Judge all cases, in order.

    Args:
        cases: the cases.
        progress: wraps the verdicts as they come; is told how many.
        longest: s, after which a case counts as hanging.
    """
    local = threading.local()
    workers: list[_Worker] = []

    def ask(case: Case) -> Verdict:
        if not hasattr(local, "worker"):
            local.worker = _Worker(longest)
            workers.append(local.worker)
        found: Verdict = local.worker.ask(case)
        return found

    with ThreadPoolExecutor(WORKERS) as pool:
        try:
            return list(progress(pool.map(ask, cases), len(cases)))
        finally:
            pool.shutdown(cancel_futures=True)
            for worker in workers:
                worker.stop()


class _Worker:
    """A process that judges one case after the other, and is replaced when it does not answer."""

    def __init__(self, longest: float) -> None:
        self._longest = longest
        self._process: subprocess.Popen[str] | None = None
        self._lines: queue.Queue[str] = queue.Queue()

    def ask(self, case: Case) -> Verdict:
        """Return the verdict on a case."""
        process = self._process or self._started()
        assert process.stdin is not None
        process.stdin.write(json.dumps([type(case).__name__, asdict(case)]) + "\n")
        process.stdin.flush()
        try:
            line = self._lines.get(timeout=self._longest)
        except queue.Empty:
            self.stop()
            return _ended(case, "hang", f"no answer in {self._longest:g} s")
        if not line:
            status = process.wait()
            self.stop()
            return _ended(case, "exception", f"the process ended with status {status}")
        return Verdict(**json.loads(line))

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
        self._process = None

    def _started(self) -> "subprocess.Popen[str]":
        command = [sys.executable, "-m", "tkamb.studies.stability"]
        pipe = subprocess.PIPE
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)
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


def judge_safely(case: Case) -> Verdict:
    """Return the verdict on a case; an exception that is no clean error is a verdict too."""
    try:
        return judge(case) if isinstance(case, Extreme) else judge_scene(case)
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
        "rows": [verdict.as_dict() for verdict in verdicts],
    }


def _answers() -> Iterator[Verdict]:
    kinds = {"Extreme": Extreme, "SceneExtreme": SceneExtreme}
    for line in sys.stdin:
        kind, fields = json.loads(line)
        yield judge_safely(kinds[kind](**fields))


if __name__ == "__main__":
    for verdict in _answers():
        print(json.dumps(verdict.as_dict()), flush=True)
