"""Output of a cohort: table of frames, runs, groups, provenance and report."""

import json
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.errors import not_installed
from tkamb.files import replaced_together, sha256_of, write_rows, write_synced
from tkamb.run.columns import ordered_names
from tkamb.run.results import page
from tkamb.studies.cohort.outcome import Outcome
from tkamb.studies.cohort.plan import GROUP_AXES, Cohort, CohortRun
from tkamb.studies.cohort.statistics import group_rows, groups_of

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError:
    raise not_installed("pyarrow", "the table of a cohort", "cohort") from None

TABLE_NAME, RUNS_NAME, GROUPS_NAME = "cohort.parquet", "runs.csv", "groups.csv"
SUMMARY_NAME, REPORT_NAME = "cohort.json", "cohort.html"
LABELS = ("subject", *GROUP_AXES)


def write_cohort(
    cohort: Cohort, outcomes: Mapping[int, Outcome], identity: Mapping[str, Any], folder: Path
) -> None:
    """Write the table, runs.csv, groups.csv, cohort.json and cohort.html: all or none.

    Raises:
        InputError: the folder cannot be written.
    """
    groups = groups_of(cohort, outcomes)
    runs = run_rows(cohort, outcomes)
    with replaced_together(folder) as files:
        table = frame_table(cohort, outcomes, identity)
        with open(files.path(TABLE_NAME), "wb") as file:
            pq.write_table(table, file, compression="zstd")
        write_rows(files.path(RUNS_NAME), runs)
        write_rows(files.path(GROUPS_NAME), group_rows(groups, cohort.group_by))
        write_synced(files.path(REPORT_NAME), page("cohort")(cohort, outcomes, groups))
        names = (TABLE_NAME, RUNS_NAME, GROUPS_NAME, REPORT_NAME)
        summary = {
            "title": cohort.table.title,
            "cohort": str(cohort.path.absolute()),
            "written": datetime.now(UTC).isoformat(timespec="seconds"),
            "command": " ".join(["tkamb", *sys.argv[1:]]),
            "runs": len(outcomes),
            "failed_runs": [
                {"run": n, "labels": cohort.runs[n].labels, "reason": one.reason}
                for n, one in outcomes.items()
                if one.reason
            ],
            "group_by": cohort.group_by,
            "identity": identity,
            "files": {name: sha256_of(files.path(name)) for name in names},
        }
        text = json.dumps(summary, indent=2, ensure_ascii=False)
        write_synced(files.path(SUMMARY_NAME), text + "\n")


def frame_table(
    cohort: Cohort, outcomes: Mapping[int, Outcome], identity: Mapping[str, Any]
) -> pa.Table:
    """Return a row per frame of every run with results: labels, provenance and numbers.

    The columns are those of results.csv that any run has, null where a run has none; before them
    stand the labels, and the scene's SHA-256, overrides, contact model and resolution.
    """
    good = {n: one for n, one in outcomes.items() if not one.reason}
    present = dict.fromkeys(name for one in good.values() for name in one.columns)
    names = [name for name in ordered_names(present) if name in present]
    counts = [len(one.status) for one in good.values()]
    columns: dict[str, Any] = {"run": _repeated(list(good), counts, pa.int64())}
    for label in LABELS:
        columns[label] = _repeated([cohort.runs[n].labels[label] for n in good], counts)
    for name, of in PROVENANCE.items():
        columns[name] = _repeated([of(cohort.runs[n]) for n in good], counts)
    for name in names:
        parts = [
            one.columns.get(name, np.full(count, np.nan))
            for one, count in zip(good.values(), counts, strict=True)
        ]
        columns[name] = pa.array(np.concatenate([np.empty(0), *parts]), from_pandas=True)
    statuses = [status for one in good.values() for status in one.status]
    columns["status"] = pa.array(statuses, pa.string())
    about = {"title": cohort.table.title, "identity": json.dumps(dict(identity))}
    return pa.table(columns).replace_schema_metadata(about)


def _contact(run: CohortRun, key: str) -> str:
    return "" if run.scene.contact is None else str(getattr(run.scene.contact, key))


PROVENANCE = {
    "scene": lambda run: str(run.scene_path.absolute()),
    "scene_sha256": lambda run: run.scene_hash,
    "overrides": lambda run: json.dumps(run.overrides, default=str),
    "contact_model": lambda run: _contact(run, "model"),
    "contact_resolution_mm": lambda run: _contact(run, "resolution_mm"),
}
"""Column -> what it holds of a run."""


def _repeated(values: Sequence[Any], counts: Sequence[int], kind: Any = None) -> Any:
    """Return each value as often as its run has frames."""
    index = np.repeat(np.arange(len(values)), counts)
    return pa.array(values, kind or pa.string()).take(pa.array(index, pa.int64()))


def run_rows(cohort: Cohort, outcomes: Mapping[int, Outcome]) -> list[list[str]]:
    """Return runs.csv: a header, then a row per run."""
    head = ["run", *LABELS, *PROVENANCE, "frames", "failed_frames", "peak_force_total_BW", "failed"]
    names = list(dict.fromkeys(name for one in outcomes.values() for name in one.wear))
    if cohort.table.wear is not None:
        head = [*head, *(f"wear_{name}" for name in names), "wear_failed"]
    rows = [head]
    for n, one in outcomes.items():
        wear = [repr(float(one.wear[name])) if name in one.wear else "" for name in names]
        run = cohort.runs[n]
        peak = one.columns.get("force_total_BW")
        has_peak = peak is not None and bool(np.isfinite(peak).any())
        rows.append(
            [
                str(n),
                *(run.labels[label] for label in LABELS),
                *(of(run) for of in PROVENANCE.values()),
                str(len(one.status)),
                str(one.failed_frames),
                repr(float(np.nanmax(peak))) if has_peak and peak is not None else "",
                one.reason,
                *([] if cohort.table.wear is None else [*wear, one.wear_problem]),
            ]
        )
    return rows
