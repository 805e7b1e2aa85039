"""Commands in forked processes. They share tkamb's imports, so that a study takes minutes.

A child can be killed, interrupted and limited as any other process.
"""

import importlib
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

NEEDED = (
    "tkamb.cli",
    "tkamb.run.simulation",
    "tkamb.run.recording",
    "tkamb.run.maps",
    "tkamb.contact.lattice.model",
    "tkamb.contact.foundation",
    "tkamb.knee.released",
    "tkamb.show.report",
    "tkamb.show.view.show",
    "tkamb.studies.uncertainty.run",
    "tkamb.studies.cohort.run",
    "tkamb.studies.wear.run",
    "matplotlib.backends.backend_agg",
    "h5py",
    "pyarrow.parquet",
    "tqdm",
)
"""Modules that are imported once, before the first fork."""


def import_all(report: bool = True) -> None:
    """Import the modules that commands need, before the first fork.

    Args:
        report: whether the reports of runs are drawn; they take longer than short runs.
    """
    for name in NEEDED:
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            print(f"not imported: {error}", flush=True)
    if not report:
        import tkamb.show.report

        tkamb.show.report.report_html = lambda results, progress=None: "<html></html>"


def prepare_once() -> None:
    """Make runs of equal scenes share prepared knees and contact models, but no initial guesses."""
    from tkamb.run import simulation
    from tkamb.run.simulation import FrameSolver

    solvers: dict[str, FrameSolver] = {}

    def solver(case: Any, frames: Any = None) -> FrameSolver:
        key = case.scene.model_dump_json()
        if key not in solvers:
            solvers[key] = FrameSolver(case, frames)
        solvers[key].before = []
        return solvers[key]

    simulation.FrameSolver = solver  # type: ignore[assignment,misc]


class Forked:
    """A command line in a separate process.

    Args:
        arguments: arguments of `tkamb`.
        folder: working directory of the process.
        prepare: function that the child calls first, for example to set limits.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        folder: Path,
        prepare: Callable[[], None] = lambda: None,
    ) -> None:
        self._files = [tempfile.TemporaryFile() for _ in range(2)]  # noqa: SIM115
        self._status: int | None = None
        self.pid = os.fork()
        if self.pid == 0:
            try:
                signal.signal(signal.SIGINT, signal.default_int_handler)
                for number, file in enumerate(self._files, 1):
                    os.dup2(file.fileno(), number)
                os.chdir(folder)
                prepare()
                from tkamb.__main__ import main

                os._exit(main([*arguments]))
            except SystemExit as end:
                os._exit(end.code if isinstance(end.code, int) else 1)
            except BaseException:
                import traceback

                os.write(2, traceback.format_exc().encode())
                os._exit(120)

    def status(self) -> int | None:
        """Return the exit status; negative after a signal, None while the process runs."""
        if self._status is None:
            ended, status = os.waitpid(self.pid, os.WNOHANG)
            if ended:
                self._status = os.waitstatus_to_exitcode(status)
        return self._status

    def wait(self, longest: float) -> int | None:
        """Wait for the end, at most `longest` seconds; return `status`."""
        end = time.monotonic() + longest
        while self.status() is None and time.monotonic() < end:
            time.sleep(0.01)
        return self.status()

    def signal(self, number: int) -> None:
        """Send a signal to a process that still runs."""
        if self.status() is None:
            os.kill(self.pid, number)

    def printed(self) -> tuple[str, str]:
        """Return the text of standard output and standard error."""
        texts = []
        for file in self._files:
            file.seek(0)
            texts.append(file.read().decode(errors="replace"))
        return texts[0], texts[1]


def ended(
    arguments: Sequence[str], folder: Path, prepare: Callable[[], None] = lambda: None
) -> subprocess.CompletedProcess[str]:
    """Run a command line to its end."""
    process = Forked(arguments, folder, prepare)
    status = process.wait(3600.0)
    if status is None:
        raise TimeoutError(f"no end: {arguments}")
    return subprocess.CompletedProcess([*arguments], status, *process.printed())
