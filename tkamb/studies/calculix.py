"""CalculiX as a process: one thread, a time limit, its peak memory and its output."""

import math
import os
import shutil
import subprocess
import tempfile
import time as clock
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import Array
from tkamb.geometry.memory import peak_rss
from tkamb.studies.measures import ONE_THREAD

PROGRAM = "ccx"


@dataclass(frozen=True)
class CalculixSettings:
    """How long CalculiX may take."""

    longest_seconds: float = 600.0
    """s: a run that takes longer is stopped and says so. Chosen: most runs take less than a
    minute."""
    poll_seconds: float = 0.05
    """s: interval at which the memory of the process is read. Chosen: short beside a run, and
    cheap."""


CALCULIX = CalculixSettings()

OUTPUT_FILE = "output"


@dataclass(frozen=True, eq=False)
class PeerRun:
    """Results and cost of one run of CalculiX.

    Args:
        blocks: the last block of numbers of each kind in its .dat file, by the first word.
        seconds: of the process.
        peak_rss_MB: of the process (1e6 bytes).
        iterations: equilibrium iterations, one factorisation each.
    """

    blocks: dict[str, Array]
    seconds: float
    peak_rss_MB: float
    iterations: int


def find_program() -> str:
    """Return where CalculiX is.

    Raises:
        InputError: it is not installed.
    """
    result = shutil.which(PROGRAM)
    if result is None:
        raise InputError("is not installed", "CalculiX", "apt-get install calculix-ccx")
    return result


def run_calculix(text: str, longest: float = CALCULIX.longest_seconds) -> PeerRun:
    """Run a deck.

    Args:
        text: the input.
        longest: s, after which it is stopped.

    Raises:
        InputError: CalculiX is not installed.
        ComputationError: it stopped with an error, or was stopped.
    """
    program = find_program()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "peer.inp").write_text(text, encoding="utf-8")
        start = clock.perf_counter()
        memory = _wait([program, "-i", "peer"], place, longest)
        seconds = clock.perf_counter() - start
        if not (place / "peer.dat").exists():
            raise ComputationError(
                f"gave no output: {_last_words(place / OUTPUT_FILE)}", "CalculiX"
            )
        blocks = _blocks((place / "peer.dat").read_text(encoding="utf-8").splitlines())
        iterations = _iterations((place / "peer.cvg").read_text(encoding="utf-8"))
        return PeerRun(blocks, seconds, memory, iterations)


def _wait(command: list[str], place: Path, longest: float) -> float:
    """Run a command to its end with one thread; return its peak memory, MB."""
    memory, start = math.nan, clock.perf_counter()
    with (
        open(place / OUTPUT_FILE, "wb") as output,
        subprocess.Popen(
            command, cwd=place, stdout=output, stderr=subprocess.STDOUT, env=os.environ | ONE_THREAD
        ) as process,
    ):
        try:
            while process.poll() is None:
                memory = float(np.fmax(memory, peak_rss(process.pid)))  # NaN once it has ended
                if clock.perf_counter() - start > longest:
                    raise ComputationError(f"stopped after {longest:g} s", "CalculiX")
                with suppress(subprocess.TimeoutExpired):
                    process.wait(CALCULIX.poll_seconds)
        finally:
            process.kill()
    if process.returncode:
        raise ComputationError(f"stopped: {_last_words(place / OUTPUT_FILE)}", "CalculiX")
    return memory


def _last_words(path: Path) -> str:
    """Return the line with the error, or the last one."""
    lines = [line.strip(" *") for line in path.read_text(errors="replace").splitlines()]
    lines = [line for line in lines if line]
    wrong = [line for line in lines if line.lower().startswith("error")]
    return (wrong or lines or ["it said nothing"])[-1]


def _iterations(text: str) -> int:
    """Count the lines of a .cvg file that belong to an iteration: step, increment, ..."""
    return sum(line.split()[:1] != [] and line.split()[0].isdigit() for line in text.splitlines())


def _blocks(lines: Iterable[str]) -> dict[str, Array]:
    """Return the blocks of numbers; a title's first word, and its set, name one."""
    blocks: dict[str, list[list[float]]] = {}
    rows: list[list[float]] = []
    for line in lines:
        words = line.split()
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            named = words[words.index("set") + 1] if "set" in words else words[0]
            rows = blocks[named] = []
            continue
        if numbers:
            rows.append(numbers)
    return {name: np.array(rows) for name, rows in blocks.items() if rows}
