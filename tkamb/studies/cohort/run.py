"""All runs of a cohort: computed by workers, stored when finished, then combined in one table."""

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tkamb import __version__, code_identity
from tkamb.errors import InputError
from tkamb.io.claim import claimed_directory, is_ours
from tkamb.run.guard import interrupt_as_such
from tkamb.run.identity import CONTACT_CODE, contact_code
from tkamb.run.recorder import Shards
from tkamb.run.results_folder import remove_shards
from tkamb.run.workers import PoolOptions, Progress, Task
from tkamb.studies.cohort.folder import write_cohort
from tkamb.studies.cohort.outcome import CohortWorker, Outcome
from tkamb.studies.cohort.plan import Cohort, load_cohort

SHARD_NAME = "shard-{}-of-{}"
MOST_SHARDS = 10_000


@dataclass(frozen=True)
class Part:
    """Which of a cohort's runs a job of a batch queue computes.

    Args:
        index: from 1.
        count: of jobs.

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
            words = f"{len(outcomes)} of {len(numbers)} runs are kept; go on with --resume"
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
            shard = shards.get(number)
            if shard is not None:
                result[number] = Outcome.of(shard)
    return result
