"""Cost and effect of multibody settings: coupling, filter, frame rate, patella and wrapping.

Each run changes one setting of the shipped knee bend. It is compared with the run as shipped at
the same instants. A lower frame rate removes rows of the recordings (motion, shank and ground
reaction), so the derivatives come from the remaining rows.
"""

import json
import tempfile
import time as clock
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.errors import InputError, TkambError
from tkamb.geometry.frames import Array
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.run.simulation import simulate
from tkamb.studies.cases import copied_scene, thin_out
from tkamb.studies.kept_rows import KeptRows, row_key

if TYPE_CHECKING:
    from tkamb.run.results import Results


# Recorded frames from one compared frame to the next. Every frame rate of the study
# contains these frames.
STRIDE = 10


@dataclass(frozen=True)
class Change:
    """One change of the shipped scene.

    Args:
        keys: dotted key of the scene -> value that replaces the shipped one.
    """

    keys: dict[str, Any] = field(default_factory=dict)
    every: int = 1


CHANGES: dict[str, Change] = {
    "as shipped": Change(),
    "coupled: points": Change({"contact.coupling": "points"}),
    "released: adduction": Change({"contact.released": ["adduction"]}),
    "filtered at 6 Hz": Change({"motion.cutoff_Hz": 6.0}),
    "filtered at 2 Hz": Change({"motion.cutoff_Hz": 2.0}),
    "filtered at 1 Hz": Change({"motion.cutoff_Hz": 1.0}),
    "every 2nd frame": Change(every=2),
    "every 5th frame": Change(every=5),
    "every 10th frame": Change(every=10),
    "patella solved": Change({"patella.motion": "solved"}),
    "no wrapping": Change({"quadriceps.wrap": False, "patellar_ligament.wrap": False}),
    "no friction": Change({"contact.friction": 0.0}),
    "femoral adjustment": Change({"contact.adjust": True}),
}
COMPARED = ("force_total_N", "quadriceps_N", "medial_force_N", "medial_peak_pressure_MPa")
DERIVATIVES = ("velocity", "acceleration")
HEADS = {
    "force_total_N": "force",
    "peak_force": "peak force",
    "quadriceps_N": "quadriceps",
    "medial_force_N": "medial",
    "medial_peak_pressure_MPa": "peak p",
    "velocity": "velocity",
    "acceleration": "acceleration",
}
CLOCKS = ("query_seconds", "body_seconds", "contact_seconds")


@dataclass(frozen=True)
class BodyRow:
    """Cost and effect of one change.

    Args:
        status: "ok", the error, or the number of failed frames.
        prepare_seconds: time of the run outside its frames, s.
        frame_seconds: median time per frame, s.
        changed: column, "peak_force", or derivative of flexion -> largest change over the
            frames, relative to the largest value as shipped.
    """

    name: str
    status: str
    prepare_seconds: float = float("nan")
    frame_seconds: float = float("nan")
    changed: dict[str, float] | None = None


def run_body_trade(rows: KeptRows | None = None) -> Iterator[BodyRow]:
    """Run the shipped knee bend with each change alone and yield one row per change.

    Args:
        rows: stored rows of earlier studies. They are not computed again; new rows are added.
    """
    base: _Run | None = None
    for name, change in CHANGES.items():
        key = row_key("body", name, asdict(change))
        row = rows.read(key, BodyRow) if rows else None
        if row is None:
            base = base or _run(CHANGES["as shipped"])
            row = _row(name, change, base)
            if rows:
                rows.put(key, asdict(row))
        yield row


@dataclass(frozen=True, eq=False)
class _Run:
    results: "Results"
    derivatives: dict[str, Array]
    seconds: float


def _run(change: Change) -> _Run:
    with tempfile.TemporaryDirectory() as folder:
        path = copied_scene(Path(folder))
        if change.every > 1:
            thin_out(Path(folder), change.every)
        frames = slice(0, None, STRIDE // change.every)
        start = clock.perf_counter()
        scene = load_scene(path, change.keys)
        results = simulate(scene, frames=frames)
        seconds = clock.perf_counter() - start
        motion = load_case(scene).motion
        derivatives = {name: getattr(motion, name)[frames, 5] for name in DERIVATIVES}
    return _Run(results, derivatives, seconds)


def _row(name: str, change: Change, base: _Run) -> BodyRow:
    try:
        run = base if change == Change() else _run(change)
    except TkambError as error:
        return BodyRow(name, str(error))
    result = run.results
    frame_seconds = sum(np.nan_to_num(result[column]) for column in CLOCKS)
    failed = sum(status.startswith("failed") for status in result.status)
    status = f"{failed} of {len(result)} frames failed" if failed else "ok"
    outside = run.seconds - float(np.sum(frame_seconds))
    return BodyRow(name, status, outside, float(np.median(frame_seconds)), _changed(run, base))


def _changed(run: _Run, base: _Run) -> dict[str, float]:
    result, before = run.results, base.results
    changed = {column: _change(result[column], before[column]) for column in COMPARED}
    peaks = [float(np.nanmax(results["force_total_N"])) for results in (result, before)]
    changed["peak_force"] = abs(peaks[0] / peaks[1] - 1)
    for name in DERIVATIVES:
        changed[name] = _change(run.derivatives[name], base.derivatives[name])
    return changed


def _change(values: Array, base: Array) -> float:
    finite = np.isfinite(values) & np.isfinite(base)
    if not finite.any():
        return float("nan")
    return float(np.abs(values - base)[finite].max() / np.abs(base[finite]).max())


def body_json(rows: Sequence[BodyRow]) -> str:
    """Return the rows as JSON text."""
    return json.dumps([asdict(row) for row in rows], indent=1) + "\n"


def body_table(rows: Sequence[BodyRow]) -> list[str]:
    """Return the lines of the printed table."""
    head = " ".join(f"{text:>12s}" for text in HEADS.values())
    lines = [f"{'knee bend':20s} {'ms per frame':>12s} {'prep s':>6s} {head}"]
    for row in rows:
        times = f"{row.name:20s} {1e3 * row.frame_seconds:12.1f} {row.prepare_seconds:6.2f}"
        if row.changed is None:
            lines.append(f"{row.name:20s} {row.status}")
            continue
        shares = " ".join(f"{100 * row.changed[name]:10.2f} %" for name in HEADS)
        lines.append(f"{times} {shares}" + ("" if row.status == "ok" else f"  {row.status}"))
    return [
        *lines,
        "largest change over the frames, relative to the largest value as shipped; velocity and"
        " acceleration are of flexion",
    ]


def read_body_rows(path: Path) -> list[BodyRow]:
    """Return the rows of a body.json.

    Raises:
        InputError: the file is missing or has other content.
    """
    try:
        return [BodyRow(**row) for row in json.loads(path.read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"is not a table of the body's trade-off ({error})", path) from None
