"""Computation of a cohort, from its file to the written results.

Workers compute the runs, each of which is stored at once. At the end the table of all frames,
runs.csv, groups.csv, cohort.json and the report are written together.
"""

import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from tkamb import __version__, code_identity
from tkamb.errors import InputError, not_installed
from tkamb.files import replaced_together, sha256_of, write_rows, write_synced
from tkamb.io.claim import claimed_directory, is_ours
from tkamb.run.columns import ordered_names
from tkamb.run.identity import CODE, CONTACT_CODE, contact_code
from tkamb.run.recorder import Shards, completed, stored
from tkamb.run.results_folder import remove_shards
from tkamb.run.workers import PoolOptions, Progress, Task
from tkamb.studies.cohort.outcome import CohortWorker, Group, Outcome, group_rows, groups_of
from tkamb.studies.cohort.plan import GROUP_AXES, Cohort, CohortRun, load_cohort

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError:
    raise not_installed("pyarrow", "the table of a cohort", "cohort") from None

TABLE_NAME, RUNS_NAME, GROUPS_NAME = "cohort.parquet", "runs.csv", "groups.csv"
SUMMARY_NAME, REPORT_NAME = "cohort.json", "cohort.html"
LABELS = ("subject", *GROUP_AXES)
Report = Callable[[Cohort, Mapping[int, Outcome], list[Group]], str]
"""Makes the page cohort.html."""


def write_cohort(
    cohort: Cohort,
    outcomes: Mapping[int, Outcome],
    identity: Mapping[str, Any],
    folder: Path,
    report: Report | None = None,
) -> None:
    """Write cohort.parquet, runs.csv, groups.csv, cohort.json and a cohort.html, all or none."""
    groups = groups_of(cohort, outcomes)
    runs = run_rows(cohort, outcomes)
    with replaced_together(folder) as files:
        table = frame_table(cohort, outcomes, identity)
        with open(files.path(TABLE_NAME), "wb") as file:
            pq.write_table(table, file, compression="zstd")
        write_rows(files.path(RUNS_NAME), runs)
        write_rows(files.path(GROUPS_NAME), group_rows(groups, cohort.group_by))
        names = [TABLE_NAME, RUNS_NAME, GROUPS_NAME]
        if report is None:
            files.remove(REPORT_NAME)
        else:
            write_synced(files.path(REPORT_NAME), report(cohort, outcomes, groups))
            names.append(REPORT_NAME)
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
    """Return the table of the frames of all successful runs, with one row per frame.

    Labels and provenance of the run (`PROVENANCE`) come first, then the columns of results.csv that
    a run has, null for the others.
    """
    successful = {n: outcome for n, outcome in outcomes.items() if not outcome.reason}
    present = dict.fromkeys(name for outcome in successful.values() for name in outcome.columns)
    names = [name for name in ordered_names(present) if name in present]
    counts = [len(outcome.status) for outcome in successful.values()]
    columns: dict[str, Any] = {"run": _repeated(list(successful), counts, pa.int64())}
    for label in LABELS:
        columns[label] = _repeated([cohort.runs[n].labels[label] for n in successful], counts)
    for name, of in PROVENANCE.items():
        columns[name] = _repeated([of(cohort.runs[n]) for n in successful], counts)
    for name in names:
        parts = [
            outcome.columns.get(name, np.full(count, np.nan))
            for outcome, count in zip(successful.values(), counts, strict=True)
        ]
        columns[name] = pa.array(np.concatenate([np.empty(0), *parts]), from_pandas=True)
    statuses = [status for outcome in successful.values() for status in outcome.status]
    columns["status"] = pa.array(statuses, pa.string())
    metadata = {"title": cohort.table.title, "identity": json.dumps(dict(identity))}
    return pa.table(columns).replace_schema_metadata(metadata)


def _contact(run: CohortRun, key: str) -> str:
    return "" if run.scene.contact is None else str(getattr(run.scene.contact, key))


PROVENANCE = {
    "scene": lambda run: str(run.scene_path.absolute()),
    "scene_sha256": lambda run: run.scene_hash,
    "overrides": lambda run: json.dumps(run.overrides, default=str),
    "contact_model": lambda run: _contact(run, "model"),
    "contact_resolution_mm": lambda run: _contact(run, "resolution_mm"),
}
"""Column -> function that returns its text for a run."""


def _repeated(values: Sequence[Any], counts: Sequence[int], kind: Any = None) -> Any:
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


SHARD_NAME = "shard-{}-of-{}"
MOST_SHARDS = 10_000


@dataclass(frozen=True)
class Part:
    """Part of a cohort's runs that one job of a batch queue computes.

    Args:
        index: number of the part, from 1 to `count`.
    """

    index: int
    count: int

    def __post_init__(self) -> None:
        if not 1 <= self.index <= self.count <= MOST_SHARDS:
            raise InputError(
                f"{self.index}/{self.count} is not a part",
                "--shard",
                "give 1/n to n/n, n at most 10000",
            )

    @property
    def folder(self) -> str:
        """Return the part's folder inside that of the cohort."""
        return SHARD_NAME.format(self.index, self.count)

    def holds(self, number: int) -> bool:
        """Return whether a run, every `count`-th, belongs to the part."""
        return number % self.count == self.index - 1


def run_cohort(
    cohort: Cohort | str | Path,
    directory: str | Path,
    *,
    crew: PoolOptions | None = None,
    part: Part | None = None,
    resume: bool = False,
    force: bool = False,
    progress: Progress = lambda runs, count: runs,
    report: Report | None = None,
) -> dict[int, Outcome]:
    """Compute the runs of a cohort and write its table and report.

    The table does not depend on the number of workers or parts. A failed run is listed with its
    reason and does not stop the cohort.

    Args:
        directory: folder of the results. A part is stored in a folder inside it, without table
            and report.
        crew: worker pool settings; default: this process.
        part: part of the runs to compute; default: all.
        resume: use the runs that are stored in the folder, also those of parts.
        force: write into the folder even if it contains files of other programs.
        progress: wrapper of the iterator of the finished runs.
        report: function that returns the page cohort.html; None: the folder has no report.

    Returns:
        Number of the run -> its outcome, for all runs of the cohort or of the part.

    Raises:
        InputError: the input is invalid, or the folder holds another cohort or is in use.
        ComputationError: a worker process ended during a run.
        KeyboardInterrupt: interrupted. The finished runs stay in the folder.
    """
    cohort = cohort if isinstance(cohort, Cohort) else load_cohort(cohort)
    crew = crew or PoolOptions()
    crew.check()
    identity = _identity(cohort)
    directory = Path(directory)
    folder = directory if part is None else directory / part.folder
    force = force or (part is None and _holds_parts_alone(directory))
    with claimed_directory(folder, force, "cohort"), _parts(directory, part, resume) as parts:
        shards = Shards(folder, identity, resume)
        part_shards = [Shards(part_folder, identity, True) for part_folder in parts]
        numbers = [run.number for run in cohort.runs if part is None or part.holds(run.number)]
        outcomes = stored([shards, *part_shards], numbers, Outcome.of)
        remaining = [(n, cohort.runs[n]) for n in numbers if n not in outcomes]
        task = Task(CohortWorker, (cohort.frames, cohort.table.map_flexion_deg, cohort.table.wear))
        answers = progress(crew.answers(task, remaining), len(remaining))
        completed(
            outcomes,
            answers,
            lambda number, outcome: shards.put(number, outcome.shard()),
            f"{len(numbers)} runs",
        )
        outcomes = {number: outcomes[number] for number in numbers}
        if part is None:
            write_cohort(cohort, outcomes, identity, folder, report)
            for shard_folder in (folder, *parts):
                remove_shards(shard_folder)
    return outcomes


def _identity(cohort: Cohort) -> dict[str, Any]:
    code: dict[str, Any] = {"version of tkamb": __version__, CODE: code_identity()}
    models = sorted({run.scene.contact.model for run in cohort.runs if run.scene.contact})
    foreign = {name: result for name in models if (result := contact_code(name)) is not None}
    return cohort.identity() | code | ({CONTACT_CODE: foreign} if foreign else {})


@contextmanager
def _parts(directory: Path, part: Part | None, resume: bool) -> Iterator[list[Path]]:
    with ExitStack() as stack:
        folders = []
        if part is None and resume:
            folders = sorted(directory.glob(SHARD_NAME.format("*", "*")))
        for folder in folders:
            stack.enter_context(claimed_directory(folder, command="cohort"))
        yield folders


def _holds_parts_alone(directory: Path) -> bool:
    """Return whether a folder contains only folders of a cohort's parts."""
    entries = list(directory.iterdir()) if os.path.isdir(directory) else []
    named = all(entry.match(SHARD_NAME.format("*", "*")) for entry in entries)
    return bool(entries) and named and all(is_ours(entry) for entry in entries)
