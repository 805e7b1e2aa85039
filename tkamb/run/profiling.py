"""What a run touched: parts built, files read, modules imported, frames evaluated, time per part.

`tkamb run --profile`. Only what the scene requires should appear here.
"""

import math
import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tkamb.run.results import Results

HEAVY = ("pinocchio", "trimesh", "scipy", "fcl", "numba", "h5py", "matplotlib", "pydantic")
"""Libraries worth naming."""
CLOCKS = {
    "closest points": "query_seconds",
    "equations of motion": "body_seconds",
    "contact": "contact_seconds",
}


@dataclass(eq=False)
class Profile:
    """Watches a run from the moment it is made.

    Attributes:
        opened: files that were opened for reading, in order.
    """

    opened: list[Path] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._before = set(sys.modules)
        sys.addaudithook(self._hear)

    def report(self, results: "Results", scene: Path) -> dict[str, Any]:
        """Return what was touched, JSON-able.

        Args:
            results: of the run.
            scene: its file; files beside or below it count as the scene's, as what it names does.
        """
        seconds = dict(results.summary["seconds"])
        whole = seconds.pop("all")
        for name, column in CLOCKS.items():
            finite = [float(value) for value in results[column] if math.isfinite(value)]
            if finite:
                seconds[name] = sum(finite)
        seconds["all else"] = max(0.0, whole - sum(seconds.values()))
        modules = sorted(set(sys.modules) - self._before)
        return {
            "seconds": seconds | {"all": whole},
            "frames": len(results),
            "not_modelled": results.summary["not_modelled"],
            "files": [str(path) for path in self._of_scene(scene, results.summary["inputs"])],
            "modules": [name for name in modules if name.startswith("tkamb")],
            "libraries": [name for name in HEAVY if name in sys.modules],
        }

    def _of_scene(self, scene: Path, named: Iterable[str]) -> list[Path]:
        folder, elsewhere = scene.resolve().parent, {Path(name).resolve() for name in named}
        opened = dict.fromkeys(path.resolve() for path in self.opened)
        own = [path for path in opened if path.is_relative_to(folder) or path in elsewhere]
        return [path for path in own if path.is_file()]

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event != "open" or not isinstance(arguments[0], str):
            return
        if arguments[2] & os.O_ACCMODE == os.O_RDONLY:
            self.opened.append(Path(arguments[0]))


def profile_lines(report: dict[str, Any]) -> list[str]:
    """Return a report as lines to read."""
    whole, frames = report["seconds"]["all"], report["frames"]
    lines = ["part                       seconds   share  ms per frame"]
    for name, seconds in report["seconds"].items():
        share = f"{100 * seconds / whole:5.1f} %"
        lines.append(f"{name:24s} {seconds:9.3f} {share} {1e3 * seconds / frames:13.2f}")
    parts = "; ".join(report["not_modelled"]) or "none"
    lines.append(f"parts left out: {parts}")
    lines.append(f"files read ({len(report['files'])}): " + _names(report["files"]))
    modules = [name.removeprefix("tkamb.") for name in report["modules"]]
    lines.append(f"modules imported ({len(modules)}): " + ", ".join(modules))
    return [*lines, "libraries imported: " + ", ".join(report["libraries"])]


def _names(files: list[str]) -> str:
    return ", ".join(Path(name).name for name in files)
