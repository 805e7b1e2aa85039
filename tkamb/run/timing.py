"""Computing times: stages of a run on a terminal, and profile of `tkamb run --profile`."""

import math
import os
import sys
import time as clock
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TextIO, TypeVar

if TYPE_CHECKING:
    from tkamb.run.results import Results


_T = TypeVar("_T")


class Stages:
    """Prints the stages of a run with their times, each until the next one begins.

    Args:
        stream: output stream; None: standard error. Stages are printed on a terminal only.
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
        """End the current stage and begin a new one."""
        self.end()
        self._number += 1
        self._began, self._open = clock.perf_counter(), True
        self._write(f"{self._number}/{self._count} {name} …")

    def frames(self, indices: Sequence[int]) -> Iterable[int]:
        """Begin the stage of the frames, and return them with a progress bar."""
        return self._counted("computing frames", indices, "frame")

    def plots(self, drawn: Sequence[_T]) -> Iterable[_T]:
        """Begin the stage of the report, and return its plots with a progress bar."""
        return self._counted("writing results and report", drawn, "plot")

    def end(self) -> None:
        """End the current stage and print its time."""
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


HEAVY = ("pinocchio", "trimesh", "scipy", "fcl", "numba", "h5py", "matplotlib", "pydantic")
"""Libraries that the profile lists if they are imported."""
CLOCKS = {
    "closest points": "query_seconds",
    "equations of motion": "body_seconds",
    "contact": "contact_seconds",
    "contact of the button": "button_contact_seconds",
}


@dataclass(eq=False)
class Profile:
    """Profile of a run. It records imported modules and opened files from its creation."""

    opened: list[Path] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._before = set(sys.modules)
        sys.addaudithook(self._record_opened)

    def report(self, results: "Results", scene: Path) -> dict[str, Any]:
        """Return times, files, modules and libraries of the run as a JSON object.

        Args:
            scene: path of the scene file. Only opened files in its folder and files that the scene
                names are listed.
        """
        seconds = dict(results.summary["seconds"])
        total = seconds.pop("all")
        for name, column in CLOCKS.items():
            values = results.columns.get(column, ())
            finite = [float(value) for value in values if math.isfinite(value)]
            if finite:
                seconds[name] = sum(finite)
        seconds["all else"] = max(0.0, total - sum(seconds.values()))
        modules = sorted(set(sys.modules) - self._before)
        return {
            "seconds": seconds | {"all": total},
            "frames": len(results),
            "not_modelled": results.summary["not_modelled"],
            "files": [str(path) for path in self._of_scene(scene, results.summary["inputs"])],
            "modules": [name for name in modules if name.startswith("tkamb")],
            "libraries": [name for name in HEAVY if name in sys.modules],
        }

    def _of_scene(self, scene: Path, named: Iterable[str]) -> list[Path]:
        folder = scene.resolve().parent
        inputs = {(folder / name).resolve() for name in named}
        opened = dict.fromkeys(path.resolve() for path in self.opened)
        listed = [path for path in opened if path.is_relative_to(folder) or path in inputs]
        return [path for path in listed if path.is_file()]

    def _record_opened(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event != "open" or not isinstance(arguments[0], str):
            return
        if arguments[2] & os.O_ACCMODE == os.O_RDONLY:
            self.opened.append(Path(arguments[0]))


def profile_lines(report: dict[str, Any]) -> list[str]:
    """Return a report of `Profile` as lines of text."""
    total, frames = report["seconds"]["all"], report["frames"]
    lines = ["part                       seconds   share  ms per frame"]
    for name, seconds in report["seconds"].items():
        share = f"{100 * seconds / total:5.1f} %"
        lines.append(f"{name:24s} {seconds:9.3f} {share} {1e3 * seconds / frames:13.2f}")
    parts = "; ".join(report["not_modelled"]) or "none"
    lines.append(f"parts not modelled: {parts}")
    lines.append(f"files read ({len(report['files'])}): " + _names(report["files"]))
    modules = [name.removeprefix("tkamb.") for name in report["modules"]]
    lines.append(f"modules imported ({len(modules)}): " + ", ".join(modules))
    return [*lines, "libraries imported: " + ", ".join(report["libraries"])]


def _names(files: list[str]) -> str:
    return ", ".join(Path(name).name for name in files)
