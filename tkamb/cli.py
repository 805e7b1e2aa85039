"""The command line parses the arguments, calls a command and returns the exit status."""

import argparse
import gc
import json
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from tkamb import __version__
from tkamb.commands.check import add_check
from tkamb.commands.import_model import add_data, add_import
from tkamb.commands.mesh import add_contact, add_mesh, add_no_cache, add_press, without_cache
from tkamb.commands.options import (
    add_examples,
    add_preset,
    add_scene_options,
    check_options,
    option,
    overrides_of,
)
from tkamb.commands.results import (
    add_compare,
    add_export,
    add_folder_commands,
    reading_results,
)
from tkamb.commands.settings import add_settings
from tkamb.commands.studies import add_cohort, add_stability, add_tradeoff
from tkamb.commands.uncertainty import add_uncertainty
from tkamb.commands.view import add_live, add_view
from tkamb.commands.wear import add_wear
from tkamb.geometry.threads import threads
from tkamb.io.starter import add_new
from tkamb.run.guard import guarded, log_to_stderr, say

if TYPE_CHECKING:
    from tkamb.io.scene import Scene

COLLECTED_AT = (20_000, 100)
"""Thresholds of Python's garbage collector: new objects before a collection, and collections before
older objects are included. Python's defaults (700 and 10) cause five searches of the libraries'
objects, which take 3 % of a run."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `tkamb`; return exit status 0 (success), 1 (no result, failed check) or 2 (bad input)."""
    _keep_to_one_thread()
    os.environ["MPLBACKEND"] = "agg"  # commands draw into files only
    gc.set_threshold(*COLLECTED_AT)
    options = argparse.Namespace()

    def command() -> int:
        parser = _parser()
        parser.parse_args(arguments, options)
        check_options(parser, sys.argv[1:] if arguments is None else arguments, options)
        threads()  # raises if TKAMB_THREADS is invalid
        log_to_stderr()
        with reading_results(options):
            return int(options.command(options))

    return guarded(command, options)


def _keep_to_one_thread() -> None:
    """Limit BLAS to one thread, unless the environment sets a number or NumPy is already loaded.

    Memory bandwidth limits the lattice's solver. On a busy machine, several threads wait for each
    other and take several times longer.
    """
    limits = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    if "numpy" not in sys.modules and not any(name in os.environ for name in limits):
        os.environ["OMP_NUM_THREADS"] = "1"


class _Parser(argparse.ArgumentParser):
    """Parser that prints an error as one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        for kind, words in (("float", "is not a number"), ("int", "is not a whole number")):
            message = re.sub(rf"invalid {kind} value: ('.*')", rf"\1 {words}", message)
        message = re.sub(
            r"expected (\d+) arguments", r"give \1 values, with spaces between", message
        )
        message = re.sub(
            r"argument ([\w, /-]*?)(--\w[\w-]*): expected one argument",
            r"argument \1\2: has no value; write \2=VALUE if the value begins with -",
            message,
        )
        self.exit(2, f"{self.prog}: {' '.join(message.split())}; see {self.prog} --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="tkamb", description="What happens inside a total knee replacement.")
    parser.add_argument("--version", action="version", version=f"tkamb {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    add_new(commands)
    add_check(commands)
    _add_run(commands)
    add_folder_commands(commands)
    add_compare(commands)
    add_press(commands)
    add_contact(commands)
    add_mesh(commands)
    _add_scene(commands)
    add_import(commands)
    add_data(commands)
    add_export(commands)
    add_view(commands)
    add_live(commands)
    add_tradeoff(commands)
    add_stability(commands)
    add_wear(commands)
    add_uncertainty(commands)
    add_cohort(commands)
    add_settings(commands)
    add_examples(parser)
    return parser


def _add_run(commands: Any) -> None:
    run = commands.add_parser(
        "run", help="compute condyle forces from a motion, and write a report"
    )
    add_scene_options(run)
    add_preset(run)
    add_no_cache(run)
    option(run, "--force", "write into a folder that tkamb did not make")
    option(run, "--resume", "go on with an interrupted run")
    option(run, "--workers N", "number of processes for the frames", int, default=1)
    option(run, "--profile", "list the files and modules used, and the time of each part")
    option(run, "--pack F.zip", "write results, scene and inputs into an archive", Path)
    option(run, "--strict", "exit 1 when a frame failed")
    option(run, "--json", "print summary.json")
    run.set_defaults(command=_run)


def _add_scene(commands: Any) -> None:
    scene = commands.add_parser("scene", help="the scene file")
    option(scene, "--schema", "print its JSON schema", required=True)
    scene.set_defaults(command=_scene)


def _run(options: argparse.Namespace) -> int:
    from tkamb.run.timing import Profile, profile_lines

    profile = Profile() if options.profile else None
    from tkamb.io.claim import claimed_directory
    from tkamb.run.results_folder import write_results
    from tkamb.run.simulation import simulate
    from tkamb.run.status import FAILED
    from tkamb.run.timing import Stages

    scene = _scene_of(options)
    default = Path("out") / options.scene.resolve().parent.name
    directory = options.out or scene.output.directory or default
    with Stages(4) as stages, claimed_directory(directory, options.force, "run"):
        results = simulate(
            scene,
            frames=options.frames,
            directory=directory,
            scene_path=options.scene,
            progress=stages.frames,
            stage=stages.begin,
            resume=options.resume,
            workers=options.workers,
        )
        # The frames need no matplotlib. Its import takes 0.3 s.
        from tkamb.show.axis import horizontal_axis
        from tkamb.show.headline import cards
        from tkamb.show.report import report_html

        if profile:
            results.summary["profile"] = profile.report(results, options.scene)
        write_results(results, directory, report=lambda run: report_html(run, stages.plots))
    if options.pack:
        from tkamb.run.reproduction import pack

        say(f"pack: {options.pack}, with {pack(directory, options.pack)} input files")
    failed = [k for k, status in enumerate(results.status) if status.startswith(FAILED)]
    for k in failed:
        say(f"frame {k}: {results.status[k]}")
    for remark in results.summary.get("remarks", []):
        say(f"notice: {remark}")
    for question in results.summary.get("questions", []):
        say(f"question: {question}")
    if options.json:
        print((directory / "summary.json").read_text(encoding="utf-8"), end="")
    else:
        result = cards(results, horizontal_axis(results))
        print(
            "\n".join([*(card.line() for card in result), f"report: {directory / 'report.html'}"])
        )
    if profile and not options.json:
        print("\n".join(profile_lines(results.summary["profile"])))
    return 1 if failed and (options.strict or len(failed) == len(results)) else 0


def _scene_of(options: argparse.Namespace) -> "Scene":
    from tkamb.io.scene import load_scene

    overrides = overrides_of(options)
    scene = load_scene(options.scene, overrides, options.preset)
    if not options.no_cache:
        return scene
    cache_options = without_cache(scene.contact.model if scene.contact else None)
    return load_scene(
        options.scene,
        overrides | {f"contact.options.{k}": v for k, v in cache_options.items()},
        options.preset,
    )


def _scene(options: argparse.Namespace) -> int:
    from tkamb.io.scene import scene_schema

    print(json.dumps(scene_schema(), indent=2))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
