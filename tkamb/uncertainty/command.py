"""`tkamb uncertainty`: arguments in, exit status out."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tkamb.uncertainty.run import Uncertainty

SHOWN = 5
"""Inputs of the tornado table that are printed."""
NOTABLE_FAILED = 0.05
"""Share of samples: where more fail, the bands leave out a whole tail."""


def add_uncertainty(commands: Any, frames: Any, setting: Any) -> None:
    """Add `uncertainty` to the command line.

    Args:
        commands: the parser's subcommands.
        frames: what reads A:B:STEP, as in `run`.
        setting: what reads TABLE.KEY=VALUE.
    """
    command = commands.add_parser("uncertainty", help="bands beside every result of a scene")
    command.add_argument("scene", type=Path, help="scene.toml; its [uncertainty] says what varies")
    command.add_argument("--samples", type=int, default=256, metavar="N", help="default 256")
    command.add_argument("--workers", type=int, default=1, metavar="N", help="processes; default 1")
    command.add_argument("--dask", metavar="ADDRESS|local", help="have a Dask cluster compute")
    command.add_argument("--method", default="lhs", metavar="lhs|sobol", help="default lhs")
    command.add_argument("--contact", metavar="NAME", help="contact model (`tkamb contact list`)")
    command.add_argument("--resolution", type=float, metavar="MM", help="spacing of the map points")
    command.add_argument("--out", type=Path, metavar="DIR", help="output folder")
    command.add_argument("--frames", type=frames, metavar="A:B:STEP", help="frames, as in Python")
    command.add_argument(
        "--set",
        action="append",
        default=[],
        type=setting,
        metavar="TABLE.KEY=VALUE",
        help="override a key of the scene",
    )
    command.add_argument(
        "--force", action="store_true", help="write into a folder that is not tkamb's"
    )
    command.add_argument("--resume", action="store_true", help="go on with an interrupted run")
    command.set_defaults(command=_uncertainty)


def _uncertainty(options: argparse.Namespace) -> int:
    from tqdm import tqdm

    from tkamb.scene import load_scene
    from tkamb.uncertainty.run import estimate_uncertainty

    overrides = dict(options.set)
    if options.contact:
        overrides["contact.model"] = options.contact
    if options.resolution is not None:
        overrides["contact.resolution_mm"] = options.resolution
    directory = options.out or Path("out") / f"{options.scene.resolve().parent.name}_uncertainty"
    found = estimate_uncertainty(
        load_scene(options.scene, overrides),
        samples=options.samples,
        workers=options.workers,
        dask=options.dask,
        method=options.method,
        frames=options.frames,
        directory=directory,
        scene_path=options.scene,
        resume=options.resume,
        force=options.force,
        progress=lambda samples, count: tqdm(samples, total=count, unit="sample", disable=None),
    )
    for line in warnings_of(found):
        print(f"tkamb: {line}", file=sys.stderr)
    print("\n".join([*headline(found), f"bands: {directory / 'bands.csv'}"]))
    return 1 if all(one.failed.all() for one in found.samples) else 0


def headline(found: "Uncertainty") -> list[str]:
    """Return the peak's band and what moves it most, in lines of text."""
    from numpy import isfinite, nanargmax

    total = found.results["force_total_BW"]
    if not isfinite(total).any():
        return ["no frame of the nominal run has a force"]
    peak = int(nanargmax(total))
    low, middle, high = (found.bands[f"force_total_BW_{p}"][peak] for p in ("p05", "p50", "p95"))
    flexion = found.results["flexion_deg"][peak]
    band = f"5 to 95 %: {low:.2f} to {high:.2f}, median {middle:.2f}"
    if not isfinite(low):
        band = "no band: too many samples failed"
    lines = [f"peak total force {total[peak]:.2f} BW at {flexion:.0f} deg ({band})"]
    for result in ("force_total_N", "medial_force_N"):
        rows = [row for row in found.tornado if row.result == result][:SHOWN]
        parts = ", ".join(f"{row.name} {row.share:.0%}" for row in rows if row.share >= 0.01)
        if parts:
            lines.append(f"{result} varies by {parts} (shares of variance, by regression)")
    return lines


def warnings_of(found: "Uncertainty") -> list[str]:
    """Return what the bands leave out."""
    from numpy import mean

    lines, summary = [], found.results.summary["uncertainty"]
    if summary["not_varied"]:
        names = ", ".join(summary["not_varied"])
        lines.append(f"not varied, so the bands are too narrow for them: {names}")
    share = mean([one.failed for one in found.samples], axis=0)
    if (share > NOTABLE_FAILED).any():
        lines.append(
            f"in {(share > NOTABLE_FAILED).sum()} of {len(share)} frames more than "
            f"{NOTABLE_FAILED:.0%} of the samples failed (at most {share.max():.0%}): their bands "
            "hold for the poses that are possible, see failed_share"
        )
    if not found.tornado:
        lines.append("too few samples for tornado.csv: give 6 per input or more")
    return lines
