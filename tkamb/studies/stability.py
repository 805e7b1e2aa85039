"""Stability at the extremes: every case is judged in a process of its own, which may crash or
hang."""

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
"""Verdict on each case, as last accepted; `scripts/make_stability_verdicts` writes it."""


@dataclass(frozen=True)
class StabilitySettings:
    """Limits of the stability study."""

    longest_seconds: float = 120.0
    """s: a case whose model takes longer counts as hanging. Chosen: usual cases take seconds."""
    longest_reference_seconds: float = 900.0
    """s: a case whose reference takes longer is unverified. Chosen: the study ends within a day."""
    workers: int = 2
    """Number of processes of the study. Chosen: a small computer has as many cores."""
    quick_share: int = 13
    """Ratio of all cases to those of the quick study. Chosen: it takes minutes."""
    quick_grid_mm: float = 3.0
    """mm; finest grid of the quick study. Chosen: it takes minutes."""
    quick_with_peer: int = 4
    """Number of cases of the quick study that CalculiX solves too. Chosen: it takes minutes."""


STABILITY = StabilitySettings()

PRESSED = "pressed"
"""What a process sends once the model has answered."""
QUICK_SHAPES: tuple[Shape, ...] = ("swapped", "lip", "spike")


def stability_cases(quick: bool) -> list[Case]:
    """Return the cases of the study."""
    if not quick:
        return [*closed_forms(False), *extremes(), *scene_extremes()]
    coarse = (
        replace(c, resolution_mm=max(c.resolution_mm, STABILITY.quick_grid_mm)) for c in extremes()
    )
    some = [*dict.fromkeys(coarse)][:: STABILITY.quick_share]
    shapes = [Extreme(resolution_mm=STABILITY.quick_grid_mm, shape=shape) for shape in QUICK_SHAPES]
    peered = list(beside_calculix())[: STABILITY.quick_with_peer]
    return [*closed_forms(True), *dict.fromkeys((*peered, *shapes, *some))]


def stored_verdicts(path: Path = STORED) -> dict[str, str]:
    """Return case -> kind as last accepted; nothing if there is no file."""
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
    """Judge all cases; yield their verdicts in order.

    Args:
        cases: the cases.
        longest: s, after which a case counts as hanging.
        kept: rows of an earlier study, which are not computed again; new ones are added.
        workers: cases at a time.
    """
    judges, stored = _Judges(longest, kept), stored_verdicts()
    pool = ThreadPoolExecutor(workers, initializer=_leave_interrupts_to_parent)
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
    """Return the verdicts that are kept, in the cases' order: those finished before others, too."""
    rows, stored = [_kept_verdict(kept, case, longest) for case in cases], stored_verdicts()
    return [replace(row, expected=stored.get(row.key)) for row in rows if row is not None]


def _kept_verdict(kept: KeptRows, case: Case, longest: float) -> Verdict | None:
    """Return the kept verdict on a case; None if there is none."""
    return kept.read(
        _row_key(case, longest),
        Verdict,
        lambda row: row.kind in KINDS and row.case == case.label,
    )


def _row_key(case: Case, longest: float) -> str:
    return row_key(type(case).__name__, asdict(case), longest)


class _Judges:
    """Judges each case in a new process, because a case may crash or hang.

    The processes are forked from a server process that has only imported the modules, so that a new
    one costs milliseconds. Each computes with one thread.
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
        """Return the verdict on a case, kept or new."""
        if self._kept is None:
            return self._judged_apart(case)
        result = _kept_verdict(self._kept, case, self._longest)
        if result is None:
            result = self._judged_apart(case)
            self._kept.put(_row_key(case, self._longest), asdict(result))
        return result

    def limit(self, case: Case) -> float:
        """Return after how many seconds a case counts as hanging."""
        return self._longest

    def stop(self) -> None:
        """End the processes; the cases that they judge get no verdict."""
        self._stopped = True
        for process in list(self._running):
            process.kill()

    def _judged_apart(self, case: Case) -> Verdict:
        receiver, sender = self._context.Pipe(duplex=False)
        process = self._context.Process(target=_send_verdict, args=(case, sender), daemon=True)
        process.start()
        sender.close()  # so that the process's end is seen at the other end
        self._running.add(process)
        try:
            return self._received(case, receiver)
        except EOFError:
            process.join()
            if self._stopped:
                raise ComputationError("was stopped", case.label) from None
            reason = f"the process ended with status {process.exitcode}"
            return _ended(case, "exception", reason)
        finally:
            process.kill()
            process.join()
            self._running.discard(process)

    def _received(self, case: Case, receiver: Connection) -> Verdict:
        """Return what a process sends within the limits of time; see `_send_verdict`."""
        if self._stopped:
            raise EOFError
        if not receiver.poll(self.limit(case)):
            return _ended(case, "hang", f"no answer in {self.limit(case):g} s")
        result = receiver.recv()
        if result == PRESSED:
            if not receiver.poll(STABILITY.longest_reference_seconds):
                reason = f"no reference in {STABILITY.longest_reference_seconds:g} s"
                return _ended(case, "unverified", reason)
            result = receiver.recv()
        verdict: Verdict = result
        return verdict


def _leave_interrupts_to_parent() -> None:
    """Block Ctrl-C in this thread's processes; the parent ends them.

    A process inherits the blocked signals of the thread that starts it.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


def _send_verdict(case: Case, sender: Connection) -> None:
    """Judge a case: send `PRESSED` once the model has answered, then the verdict."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent process handles Ctrl-C
    sender.send(judge_safely(case, lambda: sender.send(PRESSED)))


def _ended(case: Case, kind: str, reason: str) -> Verdict:
    return Verdict(case.label, getattr(case, "model", "run"), kind, reason)


def judge_safely(case: Case, pressed: Callable[[], None] = lambda: None) -> Verdict:
    """Return the verdict on a case; an unexpected exception is a verdict, too."""
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
        "rows": [asdict(verdict) for verdict in verdicts],
    }


def table(verdicts: Sequence[Verdict]) -> list[str]:
    """Return the counts by contact model, then the cases that failed, then the flagged ones."""
    lines = [f"{'contact':18s} {'cases':>5s} " + " ".join(f"{kind:>15s}" for kind in KINDS)]
    for model in [*dict.fromkeys(v.contact for v in verdicts), "all"]:
        some = [v for v in verdicts if model in (v.contact, "all")]
        counts = [sum(v.kind == kind for v in some) for kind in KINDS]
        lines.append(f"{model:18s} {len(some):5d} " + " ".join(f"{n:15d}" for n in counts))
    flagged = [v for v in verdicts if v.kind == "flagged" and not v.failed]
    better = [v for v in verdicts if v.kind == "converged" and v.expected not in (None, v.kind)]
    unknown = [v for v in verdicts if v.expected is None]
    groups = {"failed": [v for v in verdicts if v.failed], "flagged": flagged}
    groups |= {"better than stored": better, "no stored verdict": unknown}
    for title, some in groups.items():
        lines += ["", f"{title}: {len(some)}", *(_line(v) for v in some)]
    return lines


def _line(verdict: Verdict) -> str:
    was = f" (was {verdict.expected})" if verdict.expected not in (None, verdict.kind) else ""
    return f"  {verdict.contact}, {verdict.case}: {verdict.kind}{was}: {verdict.reason}"
