"""A cohort, from its file to the written results.

Workers compute the runs. Each finished run is stored at once. At the end the table of all frames,
runs.csv, groups.csv, cohort.json and the report are written together.
"""

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
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
from tkamb.run.guard import interrupt_as_such
from tkamb.run.identity import CONTACT_CODE, contact_code
from tkamb.run.recorder import Shards
from tkamb.run.results import page
from tkamb.run.results_folder import remove_shards
from tkamb.run.workers import PoolOptions, Progress, Task
from tkamb.studies.cohort.outcome import CohortWorker, Outcome, is_outcome
from tkamb.studies.cohort.plan import GROUP_AXES, Cohort, CohortRun, load_cohort
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


SHARD_NAME = "shard-{}-of-{}"
MOST_SHARDS = 10_000


@dataclass(frozen=True)
class Part:
    """Which of a cohort's runs a job of a batch queue computes.

    Args:
        index: number of the part, from 1.
        count: number of parts.

    Raises:
        InputError: there is no such part.
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
        """Return the name of its folder in the cohort's."""
        return SHARD_NAME.format(self.index, self.count)

    def holds(self, number: int) -> bool:
        """Say whether a run is among its own: every `count`-th one."""
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
) -> dict[int, Outcome]:
    """Compute the runs of a cohort and write its table and report.

    The same table for any number of workers and parts. A run that fails is listed with its
    reason; the others go on.

    Args:
        cohort: the cohort, or the path of its file.
        directory: the folder of all results; with a part, the part's own folder is made in it
            and neither table nor report is written.
        crew: who computes; default: this process.
        part: compute these runs alone.
        resume: go on with what earlier runs of the same cohort, or parts of it, left there.
        force: write into the folder even if it holds things that are not tkamb's.
        progress: wraps the runs as they come.

    Returns:
        Number -> what the run gave; of a part, its own runs.

    Raises:
        InputError: bad input, another cohort to resume, or a folder that cannot be claimed.
        ComputationError: a worker ended before its run.
        KeyboardInterrupt: what is finished is kept in the folder.
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
        others = [Shards(one, identity, True) for one in parts]
        numbers = [run.number for run in cohort.runs if part is None or part.holds(run.number)]
        outcomes = _kept([shards, *others], numbers)
        remaining = [(n, cohort.runs[n]) for n in numbers if n not in outcomes]
        task = Task(CohortWorker, (cohort.frames, cohort.table.map_flexion_deg, cohort.table.wear))
        answers = crew.answers(task, remaining)
        try:
            with interrupt_as_such():
                for number, outcome in progress(answers, len(remaining)):
                    shards.put(number, outcome.shard())
                    outcomes[number] = outcome
        except KeyboardInterrupt:
            words = f"{len(outcomes)} of {len(numbers)} runs are kept; go on with resume=True"
            raise KeyboardInterrupt(words) from None
        outcomes = {number: outcomes[number] for number in numbers}
        if part is None:
            write_cohort(cohort, outcomes, identity, folder)
            for one in (folder, *parts):
                remove_shards(one)
    return outcomes


def _identity(cohort: Cohort) -> dict[str, Any]:
    code: dict[str, Any] = {"version of tkamb": __version__, "code of tkamb": code_identity()}
    models = sorted({run.scene.contact.model for run in cohort.runs if run.scene.contact})
    foreign = {name: result for name in models if (result := contact_code(name)) is not None}
    return cohort.identity() | code | ({CONTACT_CODE: foreign} if foreign else {})


@contextmanager
def _parts(directory: Path, part: Part | None, resume: bool) -> Iterator[list[Path]]:
    """Lock the folders of all parts and yield them, to gather runs; none while one computes."""
    with ExitStack() as stack:
        result = []
        if part is None and resume:
            result = sorted(directory.glob(SHARD_NAME.format("*", "*")))
        for one in result:
            stack.enter_context(claimed_directory(one, command="cohort"))
        yield result


def _holds_parts_alone(directory: Path) -> bool:
    """Say whether a folder was made by parts of a cohort and holds nothing else."""
    entries = list(directory.iterdir()) if os.path.isdir(directory) else []
    named = all(entry.match(SHARD_NAME.format("*", "*")) for entry in entries)
    return bool(entries) and named and all(is_ours(entry) for entry in entries)


def _kept(places: list[Shards], numbers: list[int]) -> dict[int, Outcome]:
    """Return the runs that are finished already."""
    result: dict[int, Outcome] = {}
    for shards in places:
        for number in numbers if shards.resumed else ():
            shard = shards.get(number, is_outcome)
            if shard is not None:
                result[number] = Outcome.of(shard)
    return result
