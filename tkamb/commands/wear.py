"""`tkamb wear`: its arguments and printed lines."""

import argparse
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tkamb.commands.options import add_set, option
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
    option(
        wear,
        "--simulator PROFILE",
        "CSV with load and displacements or forces over per cent of the cycle, "
        "instead of the scene's motion",
        Path,
    )
    option(
        wear,
        "--part NAME",
        "insert (default), or button: the patellar button of a folder of results",
        default="insert",
    )
    option(wear, "--springs F", "springs of the simulator (.toml), for force control", Path)
    option(wear, "--cycles N", f"number of cycles; default {CYCLES:.0e}", _count, default=CYCLES)
    option(
        wear, "--updates M", "number of updates of the geometry; default 10", int, default=UPDATES
    )
    option(wear, "--law NAME", "wear law; default: the material's own")
    option(
        wear,
        "--material NAME|F",
        "wear material, or a material file (.toml); default: conventional",
    )
    option(
        wear,
        "--close HOW",
        "closing of a recording to a cycle: interpolate (from the last frame to the first; "
        "default), there-and-back, or 'as recorded'",
    )
    option(wear, "--wear-factor K", "wear factor, mm3/(N m), instead of the material's", float)
    option(wear, "--contact NAME", "contact model, instead of the scene's")
    option(wear, "--resolution MM", "spacing of the map points", float)
    option(
        wear,
        "--frames-per-cycle N",
        "of a recording: largest number of frames, first and last included; of a simulator's "
        "profile: smallest number of rows; default 40",
        int,
        default=FRAMES,
    )
    option(wear, "--period S", "period of a simulator's cycle, s, for creep", float, default=1.0)
    option(
        wear,
        "--samples N",
        "samples for bands; default: 32 if the scene has [uncertainty], else 0",
        int,
    )
    add_set(wear)
    option(wear, "--workers N", "number of processes for the samples", int, default=1)
    option(wear, "--out DIR", "output folder", Path)
    option(wear, "--force", "write into a folder that tkamb did not make")
    option(wear, "--resume", "go on with an interrupted simulation")
    option(wear, "--json", "print wear.json")
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
        part=options.part,
    )


def _stem(case: Path) -> str:
    path = case.resolve()
    return path.name if os.path.isdir(path) else path.parent.name
