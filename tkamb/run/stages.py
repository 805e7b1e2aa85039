"""The stages of a run by name, with time taken and time left, on a terminal; nothing in a pipe."""

import sys
import time as clock
from collections.abc import Iterable, Sequence
from typing import Self, TextIO, TypeVar

_T = TypeVar("_T")


class Stages:
    """Says on a stream what is being done; each stage ends when the next begins, or on leaving.

    Args:
        count: of the stages.
        stream: where to; default: standard error. One that is no terminal stays empty.
    """

    def __init__(self, count: int, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._shown = self._stream.isatty()
        self._count, self._number, self._began = count, 0, 0.0
        self._open = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def begin(self, name: str) -> None:
        """End the stage before and begin one."""
        self.end()
        self._number += 1
        self._began, self._open = clock.perf_counter(), True
        self._write(f"{self._number}/{self._count} {name} …")

    def frames(self, indices: Sequence[int]) -> Iterable[int]:
        """Begin the stage of the frames and return them with a bar that says the time left."""
        return self._counted("computing frames", indices, "frame")

    def plots(self, drawn: Sequence[_T]) -> Iterable[_T]:
        """Begin the last stage and return the report's plots, likewise."""
        return self._counted("writing results and report", drawn, "plot")

    def end(self) -> None:
        """End the stage, with the time that it took."""
        if self._open:
            self._write(f" {clock.perf_counter() - self._began:.1f} s\n")
        self._open = False

    def _counted(self, name: str, items: Sequence[_T], unit: str) -> Iterable[_T]:
        from tqdm import tqdm

        self.end()
        self._number += 1
        name = f"{self._number}/{self._count} {name}"
        return tqdm(items, name, unit=unit, file=self._stream, disable=not self._shown)

    def _write(self, words: str) -> None:
        if self._shown:
            self._stream.write(words)
            self._stream.flush()
