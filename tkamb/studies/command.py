"""`tkamb tradeoff` and `tkamb stability`: arguments in, exit status out."""

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")


def add_tradeoff(commands: Any) -> None:
    """Add `tradeoff` to the command line."""
    tradeoff = commands.add_parser("tradeoff", help="speed against accuracy of the contact models")
    tradeoff.add_argument(
        "scene", type=Path, nargs="?", metavar="SCENE", help="measure on your own scene too"
    )
    tradeoff.add_argument("--quick", action="store_true", help="two cases, 2 mm, within a minute")
    tradeoff.add_argument("--peer", choices=("calculix",), help="another program, side by side")
    tradeoff.add_argument("--recompute", action="store_true", help="the references too (slow)")
    tradeoff.add_argument("--out", type=Path, default=Path("out/tradeoff"), metavar="DIR")
    tradeoff.add_argument("--json", action="store_true")
    tradeoff.set_defaults(command=_tradeoff)


def _tradeoff(options: argparse.Namespace) -> int:
    from tkamb.output.atomic import claim_directory, replaced_file, write_text
    from tkamb.studies import tradeoff as study
    from tkamb.studies.body_trade import body_table, run_body_trade
    from tkamb.studies.cases import SHIPPED_SCENE
    from tkamb.studies.tradeoff_report import picture, recommendations, table

    jobs = study.jobs(options.quick, options.scene)
    directory = claim_directory(options.out)
    cases = study.cases_of(jobs)
    references = study.references_for(cases, options.recompute, _announce)
    rows = study.run_tradeoff(jobs, references, _progress("model"))
    if options.peer:
        from tkamb.studies.calculix import peer_rows

        rows = study.with_fronts([*rows, *peer_rows(cases, references)])
    text = study.as_json(rows)
    lines = [*table(rows, references), "", *recommendations(rows)]
    if not options.quick and SHIPPED_SCENE.exists():
        body = run_body_trade(progress=_progress("run"))
        lines += ["", *body_table(body)]
        write_text(directory / "body.json", json.dumps([asdict(row) for row in body], indent=1))
    write_text(directory / "tradeoff.json", text + "\n")
    write_text(directory / "tradeoff.txt", "\n".join(lines) + "\n")
    with replaced_file(directory / "tradeoff.png") as temporary:
        picture(rows).savefig(temporary, format="png", dpi=150)
    print(text if options.json else "\n".join([*lines, f"picture: {directory / 'tradeoff.png'}"]))
    return 0 if any(row.errors for row in rows) else 1


def add_stability(commands: Any) -> None:
    """Add `stability` to the command line."""
    stability = commands.add_parser("stability", help="the contact models at the extremes")
    stability.add_argument("--quick", action="store_true", help="a tenth of the contact cases")
    stability.add_argument("--resume", action="store_true", help="go on with a stopped study")
    stability.add_argument("--workers", type=int, default=2, metavar="N", help="cases at a time")
    stability.add_argument("--out", type=Path, default=Path("out/stability"), metavar="DIR")
    stability.add_argument("--json", action="store_true")
    stability.set_defaults(command=_stability)


def _stability(options: argparse.Namespace) -> int:
    from tkamb.output.atomic import claim_directory, replaced_file, write_text
    from tkamb.studies import stability as study
    from tkamb.studies.kept_rows import KeptRows
    from tkamb.studies.stability_report import picture, table

    directory = claim_directory(options.out)
    cases = study.stability_cases(options.quick)
    kept = KeptRows(directory, options.resume)
    verdicts, whole = gather(
        study.run_stability(cases, kept=kept, workers=max(1, options.workers)), len(cases), "case"
    )
    text = json.dumps(study.summary(verdicts), indent=1, allow_nan=False)
    lines = [*unfinished(len(verdicts), len(cases)), *table(verdicts)]
    write_text(directory / "stability.json", text + "\n")
    write_text(directory / "stability.txt", "\n".join(lines) + "\n")
    with replaced_file(directory / "stability.png") as temporary:
        picture(verdicts).savefig(temporary, format="png", dpi=150)
    print(text if options.json else "\n".join([*lines, f"picture: {directory / 'stability.png'}"]))
    if not whole:
        raise KeyboardInterrupt(_goes_on(len(verdicts), len(cases), directory))
    return 1 if any(v.kind in study.FAILED_KINDS for v in verdicts) else 0


def gather(found: Iterable[T], total: int, unit: str) -> tuple[list[T], bool]:
    """Collect rows under a progress bar with the time left.

    Args:
        found: the rows as they come.
        total: how many there will be.
        unit: what a row is called.

    Returns:
        The rows, and whether they are all: Ctrl-C ends the collecting, not the command.
    """
    from tqdm import tqdm

    rows: list[T] = []
    try:
        for row in tqdm(found, total=total, unit=unit, disable=None):
            rows.append(row)
    except KeyboardInterrupt:
        return rows, False
    return rows, True


def unfinished(count: int, total: int) -> list[str]:
    """Return the line that heads the table of a study that was stopped; none of a whole one."""
    return [] if count == total else [f"stopped: {count} of {total} rows", ""]


def _goes_on(count: int, total: int, directory: Path) -> str:
    return f"{count} of {total} rows are in {directory}; --resume goes on from there"


def _progress(unit: str) -> Any:
    from tqdm import tqdm

    def wrapped(items: Sequence[Any]) -> Any:
        return tqdm(items, unit=unit, disable=None)

    return wrapped


def _announce(line: str) -> None:
    print(f"tkamb: {line}", file=sys.stderr, flush=True)
