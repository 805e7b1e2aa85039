"""`tkamb cohort`: arguments in, exit status out."""

import argparse
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tkamb.run.guard import say


@dataclass(frozen=True)
class CohortOutputSettings:
    """Output of `tkamb cohort`."""

    max_failed_runs: int = 10
    """Number of failed runs that are printed; the folder has them all. Chosen: they fit on a
    screen."""


COHORT_OUTPUT = CohortOutputSettings()


def add_cohort(commands: Any) -> None:
    """Add `cohort` to the command line.

    Args:
        commands: the parser's subcommands.
    """
    command = commands.add_parser("cohort", help="subjects, trials and designs as one table")
    command.add_argument(
        "file", type=Path, metavar="FILE.toml", help="subjects, trials, designs and contact models"
    )
    command.add_argument("--workers", type=int, default=1, metavar="N", help="processes; default 1")
    command.add_argument("--dask", metavar="ADDRESS|local", help="have a Dask cluster compute")
    command.add_argument("--shard", type=_part, metavar="I/N", help="every n-th run, for a queue")
    command.add_argument("--frames", metavar="A:B:STEP", help="frames of every trial")
    command.add_argument("--out", type=Path, metavar="DIR", help="output folder")
    command.add_argument(
        "--force", action="store_true", help="write into a folder that is not tkamb's"
    )
    command.add_argument("--resume", action="store_true", help="go on with what is finished")
    command.set_defaults(command=_cohort)


def _part(text: str) -> tuple[int, int]:
    result = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if not result:
        raise argparse.ArgumentTypeError(f"'{text}' is not I/N, like 1/8")
    return int(result.group(1)), int(result.group(2))


def _cohort(options: argparse.Namespace) -> int:
    from tqdm import tqdm

    from tkamb.run.workers import PoolOptions
    from tkamb.studies.cohort.folder import REPORT_NAME
    from tkamb.studies.cohort.plan import load_cohort
    from tkamb.studies.cohort.run import Part, run_cohort

    part = None if options.shard is None else Part(*options.shard)
    crew = PoolOptions(options.workers, options.dask)
    cohort = load_cohort(options.file, options.frames)
    directory = options.out or Path("out") / options.file.resolve().stem
    outcomes = run_cohort(
        cohort,
        directory,
        crew=crew,
        part=part,
        resume=options.resume,
        force=options.force,
        progress=lambda runs, count: tqdm(runs, total=count, unit="run", disable=None),
    )
    failed = [n for n, one in outcomes.items() if one.reason]
    for n in failed[: COHORT_OUTPUT.max_failed_runs]:
        say(f"run {n} ({cohort.runs[n].words()}): {outcomes[n].reason}")
    if len(failed) > COHORT_OUTPUT.max_failed_runs:
        say(f"{len(failed) - COHORT_OUTPUT.max_failed_runs} more failed runs: see runs.csv")
    print(f"{len(outcomes) - len(failed)} of {len(outcomes)} runs computed")
    if part is None:
        print(f"report: {directory / REPORT_NAME}")
    else:
        print(f"kept: {directory / part.folder}; `tkamb cohort --resume` gathers all parts")
    if outcomes and len(failed) == len(outcomes):
        say("no run could be computed")
        return 1
    return 0
