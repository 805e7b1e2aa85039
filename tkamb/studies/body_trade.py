"""The body's own trade: what coupling, filtering, patella and wrapping cost and change.

The shipped knee bend is run with one thing changed at a time, against the run as shipped.
"""

import time as clock
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.errors import TkambError
from tkamb.results import Results
from tkamb.scene import load_scene
from tkamb.simulation import simulate
from tkamb.studies.cases import SHIPPED_SCENE

FRAMES = slice(0, 101, 10)
CHANGES: dict[str, dict[str, Any]] = {
    "as shipped": {},
    "coupled: points": {"contact.coupling": "points"},
    "released: adduction": {"contact.released": ["adduction"]},
    "filtered at 6 Hz": {"motion.cutoff_Hz": 6.0},
    "filtered at 2 Hz": {"motion.cutoff_Hz": 2.0},
    "patella solved": {"patella.motion": "solved"},
    "no friction": {"contact.friction": 0.0},
    "femoral adjustment": {"contact.adjust": True},
}
COMPARED = ("force_total_N", "quadriceps_N", "medial_force_N", "medial_peak_pressure_MPa")
CLOCKS = ("query_seconds", "body_seconds", "contact_seconds")

Progress = Callable[[Sequence[str]], Iterable[str]]


@dataclass(frozen=True)
class BodyRow:
    """What one change costs and changes.

    Args:
        name: of the change.
        status: "ok", or why there is nothing.
        prepare_seconds: of the whole run outside the frames.
        frame_seconds: per frame, median.
        changed: column -> largest change, relative to the largest value as shipped.
    """

    name: str
    status: str
    prepare_seconds: float = float("nan")
    frame_seconds: float = float("nan")
    changed: dict[str, float] | None = None


def run_body_trade(
    scene: Path = SHIPPED_SCENE, progress: Progress = lambda names: names
) -> list[BodyRow]:
    """Run a scene with one thing changed at a time.

    Args:
        scene: a scene with contact, muscles and patella.
        progress: wraps the names of the changes.
    """
    rows: list[BodyRow] = []
    base: Results | None = None
    for name in progress(list(CHANGES)):
        try:
            start = clock.perf_counter()
            found = simulate(load_scene(scene, CHANGES[name]), frames=FRAMES)
            whole = clock.perf_counter() - start
        except TkambError as error:
            rows.append(BodyRow(name, str(error)))
            continue
        base = base or found
        rows.append(_row(name, found, base, whole))
    return rows


def _row(name: str, found: Results, base: Results, whole: float) -> BodyRow:
    seconds = sum(np.nan_to_num(found[column]) for column in CLOCKS)
    failed = sum(status.startswith("failed") for status in found.status)
    changed = {column: _change(found[column], base[column]) for column in COMPARED}
    status = f"{failed} of {len(found)} frames failed" if failed else "ok"
    spent = float(np.sum(seconds))
    return BodyRow(name, status, whole - spent, float(np.median(seconds)), changed)


def _change(found: Any, base: Any) -> float:
    known = np.isfinite(found) & np.isfinite(base)
    if not known.any():
        return float("nan")
    return float(np.abs(found - base)[known].max() / np.abs(base[known]).max())


def body_table(rows: Sequence[BodyRow]) -> list[str]:
    """Return the table's lines."""
    head = " ".join(f"{name.rsplit('_', 1)[0].replace('_', ' '):>20s}" for name in COMPARED)
    lines = [f"{'knee bend with':22s} {'ms per frame':>12s} {'prepare s':>9s} {head}"]
    for row in rows:
        start = f"{row.name:22s} {1e3 * row.frame_seconds:12.1f} {row.prepare_seconds:9.2f}"
        if row.changed is None:
            lines.append(f"{row.name:22s} {row.status}")
            continue
        shares = " ".join(f"{100 * row.changed[name]:18.2f} %" for name in COMPARED)
        lines.append(f"{start} {shares}" + ("" if row.status == "ok" else f"  {row.status}"))
    return [*lines, "largest change over the frames, of the largest value as shipped"]
