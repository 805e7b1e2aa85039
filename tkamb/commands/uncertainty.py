"""`tkamb uncertainty`: its arguments and printed lines."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tkamb.commands.options import add_scene_options, option, overrides_of
from tkamb.run.guard import say

if TYPE_CHECKING:
    from tkamb.studies.uncertainty.run import Uncertainty

SHOWN = 5
"""Number of inputs that are printed per result."""
QUICK_CONTACT = {"contact.model": "foundation", "contact.resolution_mm": 2.0}
QUICK_FRAMES = 11
"""Number of frames of a screening without --frames."""
LEAST_SHOWN = 0.01
"""1: smallest share of a variance that is printed."""
TERMS = 2
"""Regressors per input: its value and its square, each of which explains by chance alone 1/n of the
variance of n samples.
"""
NOTABLE_FAILED = 0.05
"""1: share of failed samples in a frame. A larger share gives a warning."""


def add_uncertainty(commands: Any) -> None:
    """Add `uncertainty` to the command line."""
    command = commands.add_parser(
        "uncertainty", help="bands of all results of a scene from uncertain inputs"
    )
    add_scene_options(command)
    option(command, "--samples N", "number of samples; default 256", int, default=256)
    option(command, "--workers N", "number of processes; default 1", int, default=1)
    option(command, "--dask ADDRESS|local", "compute on a Dask cluster")
    option(command, "--method lhs|sobol", "sampling; default lhs", default="lhs")
    option(command, "--indices", "also Sobol' indices, with N (d + 2) samples of d inputs")
    option(command, "--screen", "vary one input at a time; takes seconds, writes nothing")
    option(command, "--force", "write into a folder that tkamb did not make")
    option(command, "--resume", "go on with an interrupted run")
    command.set_defaults(command=_uncertainty)


def _uncertainty(options: argparse.Namespace) -> int:
    from tqdm import tqdm

    from tkamb.io.scene import load_scene
    from tkamb.show.report import report_html
    from tkamb.studies.uncertainty.run import estimate_uncertainty

    overrides = overrides_of(options)
    if options.screen:
        return _screen(options, overrides)
    directory = options.out or Path("out") / f"{options.scene.resolve().parent.name}_uncertainty"
    result = estimate_uncertainty(
        load_scene(options.scene, overrides),
        samples=options.samples,
        workers=options.workers,
        dask=options.dask,
        method=options.method,
        indices=options.indices,
        frames=options.frames,
        directory=directory,
        scene_path=options.scene,
        resume=options.resume,
        force=options.force,
        progress=lambda samples, count: tqdm(samples, total=count, unit="sample", disable=None),
        report=report_html,
    )
    for line in warnings_of(result):
        say(line)
    print("\n".join([*headline(result), f"bands: {directory / 'bands.csv'}"]))
    if all(sample.failed.all() for sample in result.samples):
        say("every frame of every sample failed")
        return 1
    return 0


def _screen(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    from tqdm import tqdm

    from tkamb.io.scene import load_scene
    from tkamb.io.scene.case import load_case
    from tkamb.run.workers import PoolOptions
    from tkamb.studies.uncertainty.sensitivity import screen, screen_lines

    scene, text = load_scene(options.scene, overrides), []
    if scene.contact and not {"contact.model", "contact.resolution_mm"} & set(overrides):
        scene = load_scene(options.scene, overrides | QUICK_CONTACT)
        text.append("contact by foundation at 2 mm; --contact and --resolution choose another")
    frames = options.frames
    if frames is None:
        step = -(-len(load_case(scene).motion.time) // QUICK_FRAMES)
        frames = slice(None, None, step)
        if step > 1:
            text.append(f"frames ::{step}; --frames chooses others")
    rows = screen(
        scene,
        frames=frames,
        crew=PoolOptions(options.workers, options.dask),
        progress=lambda samples, count: tqdm(samples, total=count, unit="sample", disable=None),
    )
    from tkamb.studies.uncertainty.inputs import held_inputs

    if constants := held_inputs(load_case(scene)):
        text.append(f"not varied: {', '.join(constants)}")
    text.append("one input at a time by one standard deviation: minus, plus; no interactions")
    text.append(
        "an offset in either direction may raise a force, because the femur climbs a flank of the "
        "insert"
    )
    print("\n".join([*screen_lines(rows), *(f"({line})" for line in text)]))
    if not rows:
        say("no sample could be computed")
        return 1
    return 0


def headline(uncertainty: "Uncertainty") -> list[str]:
    """Return lines of text: the band of the peak force and the most influential inputs."""
    from numpy import isfinite, nanargmax

    from tkamb.show.headline import extreme_lines, limits_line, peak_lines

    total = uncertainty.results["force_total_BW"]
    if not isfinite(total).any():
        return ["no frame of the nominal run has a force"]
    peak = int(nanargmax(total))
    flexion = uncertainty.results["flexion_deg"][peak]
    sampled_peak = uncertainty.results.summary["uncertainty"]["peak_force_total_BW"]
    words = sampled_peak["words"]
    if sampled_peak["median"] is None:
        why = uncertainty.results.why_no_band(peak)
        value = f"{total[peak]:.2f} BW with the inputs as given, no median or band: {why}"
    else:
        value = (
            f"median {sampled_peak['median']:.2f} BW, 5 to 95 %: {sampled_peak['p05']:.2f} to "
            f"{sampled_peak['p95']:.2f}"
        )
    lines = peak_lines(uncertainty.results)
    lines += [f"peak of the resultant total force, at {flexion:.0f} deg: {value} ({words})"]
    lines += extreme_lines(uncertainty.results)
    limits = limits_line(uncertainty.results)
    lines += [limits] if limits is not None else []
    chance_share = TERMS / uncertainty.results.summary["uncertainty"]["samples"]
    chance = f"; up to {chance_share:.0%} each is chance" if chance_share >= LEAST_SHOWN else ""
    for result in ("force_total_N", "medial_force_N"):
        rows = [row for row in uncertainty.tornado if row.result == result][:SHOWN]
        parts = ", ".join(f"{row.name} {row.share:.0%}" for row in rows if row.share >= LEAST_SHOWN)
        if parts:
            lines.append(f"{result} varies by {parts} (shares of variance, by regression{chance})")
    for name, share in (
        uncertainty.results.summary["uncertainty"].get("measured_inside", {}).items()
    ):
        with_discrepancy = share.get("share_with_discrepancy")
        lines.append(
            f"the measured {name} force lies within 5 to 95 % in {share['share']:.0%} of "
            f"{share['frames']} frames"
            + (
                ""
                if with_discrepancy is None
                else f" ({with_discrepancy:.0%} if the band includes the model's discrepancy)"
            )
        )
    if words := (uncertainty.results.summary.get("discrepancy") or {}).get("words"):
        lines.append(words)
    for result in ("force_total_N", "medial_force_N"):
        parts = ", ".join(
            f"{one.name} {_with_error(one.first, one.first_error)} alone, "
            f"{_with_error(one.total, one.total_error)} in all"
            for one in [row for row in uncertainty.indices if row.result == result][:SHOWN]
        )
        if parts:
            lines.append(f"{result}, Sobol' indices and standard errors: {parts}")
    return lines


def _with_error(value: float, error: float) -> str:
    return f"{value:.2f} ± {error:.2f}".replace("-", "−")


def warnings_of(uncertainty: "Uncertainty") -> list[str]:
    """Return lines of text: the limits of the bands."""
    lines, summary = [], uncertainty.results.summary["uncertainty"]
    if summary["not_varied"]:
        names = ", ".join(summary["not_varied"])
        lines.append(f"not varied, so the bands are too narrow for them: {names}")
    share = uncertainty.bands["failed_share"]
    if (share > NOTABLE_FAILED).any():
        causes = summary["causes_of_failure"].items()
        why = ", ".join(f"{text} ({part:.0%} of the failures)" for text, part in causes)
        lines.append(
            f"in {(share > NOTABLE_FAILED).sum()} of {len(share)} frames more than "
            f"{NOTABLE_FAILED:.0%} of the samples failed (at most {share.max():.0%}), most often: "
            f"{why}; their bands hold for the poses that are possible, see failed_share"
        )
    if summary.get("unbalanced_patella"):
        lines.append(summary["unbalanced_patella"])
    if not uncertainty.tornado:
        lines.append("too few samples for tornado.csv: give 6 per input or more")
    return lines
