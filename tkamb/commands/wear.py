"""`tkamb wear`: its arguments and printed lines."""

import argparse
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tkamb.commands.options import add_set
from tkamb.errors import InputError
from tkamb.run.guard import say

if TYPE_CHECKING:
    from tkamb.studies.wear.run import WearRun

CYCLES, UPDATES, FRAMES = 5_000_000, 10, 40


def add_wear(commands: Any) -> None:
    """Add `wear` to the command line."""
    wear = commands.add_parser("wear", help="wear and creep of the insert over many cycles")
    wear.add_argument(
        "case", type=Path, metavar="SCENE|DIR", help="scene.toml, or a folder that `run` wrote"
    )
    wear.add_argument(
        "--simulator",
        type=Path,
        metavar="PROFILE",
        help="CSV with load and displacements or forces over per cent of the cycle, "
        "instead of the scene's motion",
    )
    wear.add_argument(
        "--springs",
        type=Path,
        metavar="F",
        help="springs of the simulator (.toml), for force control",
    )
    wear.add_argument(
        "--cycles",
        type=_count,
        default=CYCLES,
        metavar="N",
        help=f"number of cycles; default {CYCLES:.0e}",
    )
    wear.add_argument(
        "--updates",
        type=int,
        default=UPDATES,
        metavar="M",
        help="number of updates of the geometry; default 10",
    )
    wear.add_argument("--law", metavar="NAME", help="wear law; default: the material's own")
    wear.add_argument(
        "--material",
        metavar="NAME|F",
        help="wear material, or a material file (.toml); default: conventional",
    )
    wear.add_argument(
        "--close",
        metavar="HOW",
        help="closing of a recording to a cycle: interpolate (from the last frame to the first; "
        "default), there-and-back, or 'as recorded'",
    )
    wear.add_argument(
        "--wear-factor",
        type=float,
        metavar="K",
        help="wear factor, mm3/(N m), instead of the material's",
    )
    wear.add_argument("--contact", metavar="NAME", help="contact model, instead of the scene's")
    wear.add_argument("--resolution", type=float, metavar="MM", help="spacing of the map points")
    wear.add_argument(
        "--frames-per-cycle",
        type=int,
        default=FRAMES,
        metavar="N",
        help="of a recording: largest number of frames, first and last included; of a simulator's "
        "profile: smallest number of rows; default 40",
    )
    wear.add_argument(
        "--period",
        type=float,
        default=1.0,
        metavar="S",
        help="period of a simulator's cycle, s, for creep",
    )
    wear.add_argument(
        "--samples",
        type=int,
        metavar="N",
        help="samples for bands; default: 32 if the scene has [uncertainty], else 0",
    )
    add_set(wear)
    wear.add_argument(
        "--workers", type=int, default=1, metavar="N", help="number of processes for the samples"
    )
    wear.add_argument("--out", type=Path, metavar="DIR", help="output folder")
    wear.add_argument(
        "--force", action="store_true", help="write into a folder that tkamb did not make"
    )
    wear.add_argument("--resume", action="store_true", help="go on with an interrupted simulation")
    wear.add_argument("--json", action="store_true", help="print wear.json")
    wear.set_defaults(command=_wear)


def _count(text: str) -> int:
    """Return a whole number, which may be written like 5e6."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not value.is_integer():
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number")
    return int(value)


def _wear(options: argparse.Namespace) -> int:
    from tqdm import tqdm

    from tkamb.io.claim import claimed_directory
    from tkamb.run.workers import PoolOptions

    folder = options.out or Path("out") / f"{_stem(options.case)}_wear"
    with claimed_directory(folder, options.force, "wear") as claimed:
        crew, run = PoolOptions(options.workers), _prepared(options)
        if crew.workers > 1 and run.sampling is None:
            raise InputError("has no samples to compute", "--workers", "also give --samples")
        with tqdm(total=options.cycles, desc="wearing", unit="cycle", disable=None) as bar:
            report = run.compute(
                claimed,
                resume=options.resume,
                progress=lambda cycles: bar.update(cycles - bar.n),
                crew=crew,
                sample_progress=lambda samples, count: tqdm(
                    samples, "samples", count, unit="sample", disable=None
                ),
            )
        report.write(claimed)
    for question in report.questions():
        say(f"question: {question}")
    if report.state.end:
        say(report.state.end)
    if options.json:
        print((folder / "wear.json").read_text(encoding="utf-8"), end="")
    else:
        print("\n".join([*report.lines(), f"maps: {folder / 'wear.vtp'}"]))
    return 0


def _prepared(options: argparse.Namespace) -> "WearRun":
    from tqdm import tqdm

    from tkamb.studies.wear.run import prepare_wear

    return prepare_wear(
        options.case,
        cycles=options.cycles,
        updates=options.updates,
        law=options.law,
        material=options.material,
        wear_factor=options.wear_factor,
        simulator=options.simulator,
        springs=options.springs,
        contact=options.contact,
        resolution_mm=options.resolution,
        frames=options.frames_per_cycle,
        samples=options.samples,
        period=options.period,
        close=options.close,
        overrides=dict(options.set),
        progress=lambda frames: tqdm(frames, "running", unit="frame", disable=None),
    )


def _stem(case: Path) -> str:
    path = case.resolve()
    return path.name if os.path.isdir(path) else path.parent.name
