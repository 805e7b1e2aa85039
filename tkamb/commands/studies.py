"""`tkamb tradeoff`, `tkamb stability` and `tkamb cohort`: their arguments and printed lines."""

import argparse
import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from tkamb.commands.options import option
from tkamb.run.guard import say

# Largest number of failed runs that are printed; the folder lists all. Ten lines
# fit on a screen.
MAX_FAILED_RUNS = 10


def add_cohort(commands: Any) -> None:
    """Add `cohort` to the command line."""
    command = commands.add_parser(
        "cohort", help="run subjects, trials and designs, and write one table"
    )
    command.add_argument(
        "file",
        type=Path,
        metavar="FILE.toml",
        help="file of subjects, trials, designs and contact models",
    )
    option(command, "--workers N", "number of processes; default 1", int, default=1)
    option(command, "--dask ADDRESS|local", "compute on a Dask cluster")
    option(command, "--shard I/N", "every N-th run from the I-th, for a job queue", _part)
    option(command, "--frames A:B:STEP", "frames of every trial")
    option(command, "--out DIR", "output folder", Path)
    option(command, "--force", "write into a folder that is not tkamb's")
    option(command, "--resume", "go on with an interrupted cohort")
    command.set_defaults(command=_cohort)


def _part(text: str) -> tuple[int, int]:
    result = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if not result:
        raise argparse.ArgumentTypeError(f"'{text}' is not I/N, like 1/8")
    return int(result.group(1)), int(result.group(2))


def _cohort(options: argparse.Namespace) -> int:
    from tqdm import tqdm

    from tkamb.run.workers import PoolOptions
    from tkamb.show.cohort_report import cohort_html
    from tkamb.studies.cohort.plan import load_cohort
    from tkamb.studies.cohort.run import REPORT_NAME, Part, run_cohort

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
        report=cohort_html,
    )
    failed = [n for n, outcome in outcomes.items() if outcome.reason]
    for n in failed[:MAX_FAILED_RUNS]:
        say(f"run {n} ({cohort.runs[n].words()}): {outcomes[n].reason}")
    if len(failed) > MAX_FAILED_RUNS:
        say(f"{len(failed) - MAX_FAILED_RUNS} more failed runs: see runs.csv")
    print(f"{len(outcomes) - len(failed)} of {len(outcomes)} runs computed")
    if part is None:
        print(f"report: {directory / REPORT_NAME}")
    else:
        print(f"kept: {directory / part.folder}; `tkamb cohort --resume` gathers all parts")
    if outcomes and len(failed) == len(outcomes):
        say("no run could be computed")
        return 1
    return 0


T = TypeVar("T")
NOT_OURS = "write into a folder of another command, or that tkamb did not make"


def add_tradeoff(commands: Any) -> None:
    """Add `tradeoff` to the command line."""
    tradeoff = commands.add_parser(
        "tradeoff", help="compare speed and accuracy of the contact models"
    )
    tradeoff.add_argument(
        "scene",
        type=Path,
        nargs="?",
        metavar="SCENE",
        help="scene to measure in addition to tkamb's cases",
    )
    size = tradeoff.add_mutually_exclusive_group()
    option(size, "--quick", "two cases, 2 mm, within a minute")
    option(size, "--full", "every setting on every case")
    option(tradeoff, "--peer", "compare with another program", choices=("calculix",))
    option(tradeoff, "--recompute", "also compute the references again (slow)")
    option(tradeoff, "--resume", "go on with a stopped study")
    option(
        tradeoff,
        "--out DIR",
        "output folder; default: %(default)s",
        Path,
        default=Path("out/tradeoff"),
    )
    option(tradeoff, "--force", NOT_OURS)
    option(tradeoff, "--json", "print the rows as JSON")
    tradeoff.set_defaults(command=_tradeoff)


def _tradeoff(options: argparse.Namespace) -> int:
    from tkamb.io.claim import claimed_directory

    if options.peer:
        from tkamb.studies.calculix import find_program

        find_program()
    with claimed_directory(options.out, options.force, "tradeoff") as directory:
        return _study_tradeoff(options, directory)


def _study_tradeoff(options: argparse.Namespace, directory: Path) -> int:
    from tkamb.files import write_text
    from tkamb.show.tradeoff_report import (
        DEFAULT,
        comparison,
        picture,
        recommendations,
        table,
    )
    from tkamb.studies import tradeoff as study
    from tkamb.studies.kept_rows import KeptRows
    from tkamb.studies.tradeoff import (
        CHANGES,
        BodyRow,
        as_json,
        body_json,
        body_table,
        run_body_trade,
        with_fronts,
    )

    jobs = study.jobs(options.quick, options.scene, options.full)
    cases = study.cases_of(jobs)
    kept_rows = KeptRows(directory, options.resume)
    references = study.references_for(cases, options.recompute, say, kept_rows)
    rows, complete = gather(
        study.run_tradeoff(jobs, references, kept_rows), study.expected_seconds(jobs, cases)
    )
    row_count = len(rows)
    if complete and options.peer:
        sizes = {job.resolution_mm for job in jobs if job.label == DEFAULT}
        peer_rows, complete = gather(
            study.run_peer(cases, references, kept_rows, sizes), [1.0] * len(cases)
        )
        rows += peer_rows
    body: list[BodyRow] = []
    planned = 0
    if complete and not options.quick:
        planned = len(CHANGES)
        body, complete = gather(run_body_trade(kept_rows), [1.0] * planned)
    rows = with_fronts(rows)
    lines = [*unfinished(row_count + len(body), len(jobs) + planned), *table(rows, references)]
    lines += ["", *comparison(rows), "", *recommendations(rows)]
    if body:
        lines += ["", *body_table(body)]
        write_text(directory / "body.json", body_json(body))
    text = as_json(rows)
    _write(directory, "tradeoff", text, lines, picture(rows) if rows else None)
    print(text if options.json else "\n".join([*lines, f"picture: {directory / 'tradeoff.png'}"]))
    if not complete:
        raise KeyboardInterrupt(_resume_hint(directory))
    if not any(row.errors for row in rows):
        say("no case could be computed")
        return 1
    return 0


def add_stability(commands: Any) -> None:
    """Add `stability` to the command line."""
    stability = commands.add_parser("stability", help="test the contact models in extreme cases")
    option(stability, "--quick", "a tenth of the contact cases")
    option(stability, "--resume", "go on with a stopped study")
    option(stability, "--workers N", "number of processes; default 2", int, default=2)
    option(
        stability,
        "--out DIR",
        "output folder; default: %(default)s",
        Path,
        default=Path("out/stability"),
    )
    option(stability, "--force", NOT_OURS)
    option(stability, "--json", "print the rows as JSON")
    stability.set_defaults(command=_stability)


def _stability(options: argparse.Namespace) -> int:
    from tkamb.io.claim import claimed_directory

    with claimed_directory(options.out, options.force, "stability") as directory:
        return _study_stability(options, directory)


def _study_stability(options: argparse.Namespace, directory: Path) -> int:
    from tkamb.run.workers import PoolOptions
    from tkamb.show.study_figures import picture
    from tkamb.studies import stability as study
    from tkamb.studies.kept_rows import KeptRows
    from tkamb.studies.stability import table

    workers = PoolOptions(options.workers).workers
    cases = study.stability_cases(options.quick)
    rows = KeptRows(directory, options.resume)
    verdict_source = study.run_stability(cases, kept=rows, workers=workers)
    verdicts, complete = gather(verdict_source, [1.0] * len(cases))
    if not complete:
        verdicts = study.kept_verdicts(cases, rows)
    text = json.dumps(study.summary(verdicts), indent=1, allow_nan=False)
    lines = [*unfinished(len(verdicts), len(cases)), *table(verdicts)]
    _write(directory, "stability", text, lines, picture(verdicts) if verdicts else None)
    print(text if options.json else "\n".join([*lines, f"picture: {directory / 'stability.png'}"]))
    if not complete:
        raise KeyboardInterrupt(_resume_hint(directory))
    if failed := sum(verdict.failed for verdict in verdicts):
        say(f"{failed} of {len(verdicts)} cases failed")
        return 1
    return 0


def gather(row_source: Iterable[T], costs: Sequence[float]) -> tuple[list[T], bool]:
    """Collect rows under a progress bar that shows the remaining time.

    Args:
        costs: expected time of each row, in any unit.

    Returns:
        The rows, and whether all were computed. Ctrl-C ends the collecting, not the command.
    """
    from tqdm import tqdm

    rows: list[T] = []
    bar_format = "{desc} {percentage:3.0f}%|{bar}| {elapsed}, {remaining} left"
    with tqdm(total=sum(costs), bar_format=bar_format, smoothing=0.05, disable=None) as bar:
        bar.set_description_str(f"0 of {len(costs)} rows")
        try:
            for row, cost in zip(row_source, costs, strict=False):
                rows.append(row)
                bar.set_description_str(f"{len(rows)} of {len(costs)} rows", refresh=False)
                bar.update(cost)
        except KeyboardInterrupt:
            return rows, False
    return rows, True


def unfinished(count: int, total: int) -> list[str]:
    """Return the line above the table of a stopped study; no line for a complete study."""
    return [] if count == total else [f"stopped: {count} of {total} rows", ""]


def _resume_hint(directory: Path) -> str:
    return f"finished rows are in {directory}; --resume continues from there"


def _write(directory: Path, name: str, text: str, lines: list[str], figure: Any) -> None:
    from tkamb.files import replaced_file, write_text

    write_text(directory / f"{name}.json", text + "\n")
    write_text(directory / f"{name}.txt", "\n".join(lines) + "\n")
    if figure is not None:
        with replaced_file(directory / f"{name}.png") as temporary:
            figure.savefig(temporary, format="png", dpi=150)
