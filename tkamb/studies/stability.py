"""Stability at extreme parameters. A case may crash or hang, so it runs in its own process."""

import json
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.forkserver import ensure_running
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from tkamb.errors import ComputationError, TkambError
from tkamb.studies.closed_forms import ClosedForm, closed_forms
from tkamb.studies.extremes import Extreme, Shape, beside_calculix, extremes
from tkamb.studies.kept_rows import KeptRows, row_key
from tkamb.studies.measures import ONE_THREAD, environment
from tkamb.studies.scene_extremes import SceneExtreme, judge_scene, scene_extremes
from tkamb.studies.verdict import KINDS, Verdict, judge, judge_closed_form

Case = Extreme | ClosedForm | SceneExtreme

STORED = Path(__file__).with_name("verdicts.json")
"""Accepted verdict on each case. `scripts/make/stability_verdicts` writes the file."""


@dataclass(frozen=True)
class StabilitySettings:
    """Limits of the stability study."""

    longest_seconds: float = 120.0
    """s: processor time limit of a model; a longer case is a hang. Usual cases take
    seconds."""
    longest_reference_seconds: float = 900.0
    """s: processor time limit of a reference; a longer case is unverified. The study should
    end within a day."""
    workers: int = 2
    """Number of processes of the study. A small computer has two cores."""
    quick_share: int = 13
    """Stride of the extreme cases that the quick study takes. It should take
    minutes."""
    quick_grid_mm: float = 3.0
    """mm: smallest cell size of the quick study. It should take minutes."""
    quick_with_peer: int = 4
    """Number of cases of the quick study with a stored result of CalculiX. It should
    take minutes."""


STABILITY = StabilitySettings()

PRESSED = "pressed"
"""Message that a process sends when the model has a result."""
QUICK_SHAPES: tuple[Shape, ...] = ("swapped", "lip", "spike")


def stability_cases(quick: bool) -> list[Case]:
    """Return the cases of the full or the quick study."""
    if not quick:
        return [*closed_forms(False), *extremes(), *scene_extremes()]
    coarse = (
        replace(c, resolution_mm=max(c.resolution_mm, STABILITY.quick_grid_mm)) for c in extremes()
    )
    sample = [*dict.fromkeys(coarse)][:: STABILITY.quick_share]
    shapes = [Extreme(resolution_mm=STABILITY.quick_grid_mm, shape=shape) for shape in QUICK_SHAPES]
    with_calculix = list(beside_calculix())[: STABILITY.quick_with_peer]
    return [*closed_forms(True), *dict.fromkeys((*with_calculix, *shapes, *sample))]


def stored_verdicts(path: Path = STORED) -> dict[str, str]:
    """Return case -> kind of its accepted verdict; empty if the file does not exist."""
    if not path.exists():
        return {}
    content: dict[str, str] = json.loads(path.read_text(encoding="utf-8"))
    return content


def run_stability(
    cases: Sequence[Case],
    longest: float = STABILITY.longest_seconds,
    kept: KeptRows | None = None,
    workers: int = STABILITY.workers,
) -> Iterator[Verdict]:
    """Judge all cases and yield their verdicts in the order of the cases.

    Args:
        longest: processor time limit of a case, s. The verdict does not depend on other processes.
        kept: stored verdicts of earlier studies. They are not computed again; new ones are added.
    """
    judges, stored = _Judges(longest, kept), stored_verdicts()
    # Threads, and the processes that they start, leave Ctrl-C to this process, which stops them.
    block = (signal.SIG_BLOCK, {signal.SIGINT})
    pool = ThreadPoolExecutor(workers, initializer=signal.pthread_sigmask, initargs=block)
    try:
        for verdict in pool.map(judges.verdict, cases):
            yield replace(verdict, expected=stored.get(verdict.key))
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        judges.stop()
        pool.shutdown()


def kept_verdicts(
    cases: Sequence[Case], kept: KeptRows, longest: float = STABILITY.longest_seconds
) -> list[Verdict]:
    """Return all stored verdicts in the order of the cases, also those not yet yielded."""
    rows, stored = [_kept_verdict(kept, case, longest) for case in cases], stored_verdicts()
    return [replace(row, expected=stored.get(row.key)) for row in rows if row is not None]


def _kept_verdict(kept: KeptRows, case: Case, longest: float) -> Verdict | None:
    return kept.read(_row_key(case, longest), Verdict)


def _row_key(case: Case, longest: float) -> str:
    return row_key(type(case).__name__, asdict(case), longest)


class _Judges:
    """Judges each case in a new process, because a case may crash or hang.

    The processes are forked from a server process that has imported the modules, so a new process
    costs milliseconds. Each process computes with one thread.
    """

    def __init__(self, longest: float, rows: KeptRows | None) -> None:
        self._longest, self._kept = longest, rows
        self._running: set[BaseProcess] = set()
        self._stopped = False
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload([__name__])
        with environment(ONE_THREAD):
            ensure_running()

    def verdict(self, case: Case) -> Verdict:
        if self._kept is None:
            return self._judge_in_process(case)
        result = _kept_verdict(self._kept, case, self._longest)
        if result is None:
            result = self._judge_in_process(case)
            self._kept.put(_row_key(case, self._longest), asdict(result))
        return result

    def limit(self, case: Case) -> float:
        return self._longest

    def stop(self) -> None:
        self._stopped = True
        for process in list(self._running):
            process.kill()

    def _judge_in_process(self, case: Case) -> Verdict:
        receiver, sender = self._context.Pipe(duplex=False)
        limits = self.limit(case), STABILITY.longest_reference_seconds
        process = self._context.Process(
            target=_send_verdict, args=(case, sender, *limits), daemon=True
        )
        process.start()
        sender.close()  # otherwise the receiver does not notice that the process has ended
        self._running.add(process)
        result: Any = None
        try:
            if self._stopped:
                raise EOFError
            result = receiver.recv()
            if result == PRESSED:
                result = receiver.recv()
            verdict: Verdict = result
            return verdict
        except EOFError:
            process.join()
            if self._stopped:
                raise ComputationError("was stopped", case.label) from None
            if process.exitcode != -signal.SIGPROF:
                reason = f"the process ended with status {process.exitcode}"
                return _ended(case, "exception", reason)
            if result == PRESSED:
                return _ended(case, "unverified", f"no reference in {limits[1]:g} s")
            return _ended(case, "hang", f"no answer in {limits[0]:g} s")
        finally:
            process.kill()
            process.join()
            self._running.discard(process)


def _send_verdict(case: Case, sender: Connection, longest: float, longest_reference: float) -> None:
    def pressed() -> None:
        signal.setitimer(signal.ITIMER_PROF, longest_reference)
        sender.send(PRESSED)

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent process handles Ctrl-C
    # SIGPROF ends the process after this processor time.
    signal.setitimer(signal.ITIMER_PROF, longest)
    sender.send(judge_safely(case, pressed))


def _ended(case: Case, kind: str, reason: str) -> Verdict:
    return Verdict(case.label, getattr(case, "model", "run"), kind, reason)


def judge_safely(case: Case, pressed: Callable[[], None] = lambda: None) -> Verdict:
    """Return the verdict on a case; "exception" if it raises an unexpected exception."""
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
    """Return the content of `tkamb stability --json`."""
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
        "rows": [asdict(verdict) for verdict in verdicts],
    }


def table(verdicts: Sequence[Verdict]) -> list[str]:
    """Return the lines of the printed table: counts by contact model, then lists of cases."""
    lines = [f"{'contact':18s} {'cases':>5s} " + " ".join(f"{kind:>15s}" for kind in KINDS)]
    for model in [*dict.fromkeys(v.contact for v in verdicts), "all"]:
        group = [v for v in verdicts if model in (v.contact, "all")]
        counts = [sum(v.kind == kind for v in group) for kind in KINDS]
        lines.append(f"{model:18s} {len(group):5d} " + " ".join(f"{n:15d}" for n in counts))
    flagged = [v for v in verdicts if v.kind == "flagged" and not v.failed]
    better = [v for v in verdicts if v.kind == "converged" and v.expected not in (None, v.kind)]
    unknown = [v for v in verdicts if v.expected is None]
    groups = {"failed": [v for v in verdicts if v.failed], "flagged": flagged}
    groups |= {"better than stored": better, "no stored verdict": unknown}
    for title, group in groups.items():
        lines += ["", f"{title}: {len(group)}", *(_line(v) for v in group)]
    return lines


def _line(verdict: Verdict) -> str:
    was = f" (was {verdict.expected})" if verdict.expected not in (None, verdict.kind) else ""
    return f"  {verdict.contact}, {verdict.case}: {verdict.kind}{was}: {verdict.reason}"
