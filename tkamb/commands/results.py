"""`tkamb verify`, `report`, `methods`, `compare` and `export`: commands on folders of results."""

import argparse
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tkamb.commands.options import option
from tkamb.errors import InputError, TkambError
from tkamb.run.guard import say
from tkamb.units import MILLIMETRE

PAGE_NAME = "compare.html"
_NAMES = ("folder", "folders", "runs", "path", "case")
"""Options of all commands that may name a folder of results."""


@contextmanager
def reading_results(options: argparse.Namespace) -> Iterator[None]:
    """Name the folders of results in the error of a command that cannot use their content."""
    try:
        yield
    except (TkambError, OSError, MemoryError):
        raise
    except Exception as error:  # content of another kind raises errors of many types
        given = [getattr(options, name, None) or [] for name in _NAMES]
        paths = [path for each in given for path in (each if isinstance(each, list) else [each])]
        folders = [str(path) for path in paths if (Path(path) / "summary.json").is_file()]
        if not folders:
            raise
        words = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        what = f"cannot be read by this version of tkamb ({words})"
        raise InputError(what, ", ".join(folders), "run the scene again") from error


def add_compare(commands: Any) -> None:
    """Add `compare` to the command line."""
    compare = commands.add_parser("compare", help="two or more folders of results, side by side")
    compare.add_argument(
        "folders",
        type=Path,
        nargs="+",
        metavar="DIR",
        help="folders that `tkamb run` wrote, two or more",
    )
    option(
        compare,
        "--axis",
        "horizontal axis; default: the axis that all runs have",
        choices=("flexion", "cycle", "time"),
    )
    option(
        compare,
        "--frame K",
        "frame of the first run to show maps of; default: the frame of the largest force",
        int,
    )
    option(compare, "--out DIR", f"folder for {PAGE_NAME}; default out/compare", Path)
    option(compare, "--force", "write into a folder that tkamb did not make")
    option(compare, "--json", "print the differences as JSON")
    compare.set_defaults(command=_compare)


def _compare(options: argparse.Namespace) -> int:
    from tkamb.files import write_text
    from tkamb.io.claim import claimed_directory
    from tkamb.show.comparison import compare_folders
    from tkamb.show.comparison_page import comparison_html, table_lines

    result = compare_folders(options.folders, options.axis)
    html = comparison_html(result, options.frame)
    directory = options.out or Path("out") / "compare"
    with claimed_directory(directory, options.force) as folder:
        write_text(folder / PAGE_NAME, html)
    lines = [*table_lines(result), f"page: {folder / PAGE_NAME}"]
    text = json.dumps(result.as_dict(), indent=2) if options.json else "\n".join(lines)
    print(text)
    return 0


def add_export(commands: Any) -> None:
    """Add the command `export` to the parser's commands."""
    export = commands.add_parser("export", help="write results for other programs")
    export.add_argument("folder", type=Path, metavar="DIR", help="folder that `tkamb run` wrote")
    kind = export.add_mutually_exclusive_group(required=True)
    option(kind, "--sto F.sto", "write all columns, for OpenSim", Path)
    option(kind, "--vtp", "write pressure maps over time, for ParaView; needs --out")
    option(kind, "--figures", "write every plot as SVG, PDF and PNG; needs --out")
    option(
        kind,
        "--deck",
        "write the contact of one frame, for CalculiX or FEBio 4",
        choices=("ccx", "feb"),
    )
    option(
        export,
        "--out DIR2",
        "folder for --vtp and --figures, or file for --deck (.inp, .feb)",
        Path,
    )
    option(export, "--frame K", "for --deck: row of results.csv, from 0", int)
    option(export, "--resolution MM", "for --deck: edge of the hexahedra", float)
    option(export, "--force", "--out may be a folder that tkamb did not make")
    export.set_defaults(command=_export)


def _export(options: argparse.Namespace) -> int:
    if (options.vtp or options.deck or options.figures) and not options.out:
        hint = "--vtp --out DIR2, --figures --out DIR2, or --deck ccx --frame K --out F.inp"
        name = "--deck" if options.deck else "--vtp" if options.vtp else "--figures"
        raise InputError("needs --out", name, hint)
    if options.deck and options.frame is None:
        raise InputError("needs --frame", "--deck", "--deck ccx --frame K")
    if options.deck:
        return _export_deck(options)
    if options.figures:
        return _export_figures(options)
    return _export_maps(options) if options.vtp else _export_storage(options)


def _export_figures(options: argparse.Namespace) -> int:
    from tkamb.io.claim import claimed_directory
    from tkamb.run.results_folder import read_results
    from tkamb.show.storage import FORMATS, write_figures

    results = read_results(options.folder)
    with claimed_directory(options.out, options.force) as folder:
        names = write_figures(results, folder)
    print(f"{options.out}: {len(names)} figures as {', '.join(FORMATS)}")
    return 0


def _export_deck(options: argparse.Namespace) -> int:
    from tkamb.contact.registry import COARSEST
    from tkamb.files import write_text
    from tkamb.io.claim import check_output_file
    from tkamb.run.decks import SUFFIX, frame_press

    if options.out.suffix.lower() != SUFFIX[options.deck]:
        suffix = SUFFIX[options.deck]
        raise InputError(f"is not a {suffix} file", options.out, f"give a name like frame{suffix}")
    coarsest_mm = COARSEST / MILLIMETRE
    if options.resolution is not None and not 0 < options.resolution <= coarsest_mm:
        hint = f"give more than 0, at most {coarsest_mm:g} mm"
        raise InputError(f"resolution {options.resolution} mm", "--resolution", hint)
    check_output_file(options.out, options.force)
    result = frame_press(options.folder, options.frame, options.resolution)
    write_text(options.out, result.deck(options.deck))
    print("\n".join([f"{options.out}: {result.comments()[0]}", *result.comments()[2:]]))
    return 0


def _export_storage(options: argparse.Namespace) -> int:
    from tkamb.run.results_folder import read_results
    from tkamb.show.storage import write_results_storage

    results = read_results(options.folder)
    print(f"{options.sto}: {write_results_storage(results, options.sto)}")
    return 0


def _export_maps(options: argparse.Namespace) -> int:
    from tkamb.io.claim import claimed_directory
    from tkamb.io.mesh_files import write_map_series
    from tkamb.run.metrics import map_rows
    from tkamb.run.results_folder import read_results

    results = read_results(options.folder)
    if results.maps is None:
        raise InputError("holds no contact.h5", options.folder, "run the scene with [contact]")
    with claimed_directory(options.out, options.force) as folder:
        names, buttons = write_map_series(results.maps, folder), list[str]()
        if results.button_maps is not None and map_rows(results, results.button_maps):
            buttons = write_map_series(results.button_maps, folder, "button")
    remarks = "; a left knee's mirror image" if results.summary.get("side") == "left" else ""
    remarks += "; without the post's pressure" if "post_force_N" in results.columns else ""
    frames = f"{len(names) - 1} of {len(results)} frames"
    print(f"{options.out / names[0]}: {frames}, m and Pa in the insert frame{remarks}")
    if buttons:
        frames = f"{len(buttons) - 1} of {len(results)} frames"
        print(f"{options.out / buttons[0]}: {frames}, m and Pa in the button's frame")
    return 0


def add_folder_commands(commands: Any) -> None:
    """Add `verify`, `report` and `methods` to the command line."""
    verify = commands.add_parser("verify", help="check that a folder of results is unchanged")
    verify.add_argument(
        "folder", type=Path, metavar="DIR", help="folder that `tkamb run` wrote, or its pack (.zip)"
    )
    option(
        verify,
        "--inputs FOLDER",
        "folder with a copy of the scene and its files; default: that of the pack or the run",
        Path,
    )
    option(verify, "--rerun", "compute the run again and compare all columns")
    verify.set_defaults(command=_verify)
    report = commands.add_parser("report", help="write report.html of a folder of results again")
    report.add_argument("folder", type=Path, metavar="DIR", help="folder that `tkamb run` wrote")
    report.set_defaults(command=_report)
    methods = commands.add_parser(
        "methods",
        help="the Methods paragraph of a paper, from a folder of results",
    )
    methods.add_argument("folder", type=Path, metavar="DIR", help="folder that `tkamb run` wrote")
    methods.set_defaults(command=_methods)


def _verify(options: argparse.Namespace) -> int:
    from tkamb.run.reproduction import rerun, unpacked, verify_results

    with unpacked(options.folder) as folder:
        verdict = verify_results(folder, options.inputs)
        differs, lines = list(verdict.differs), verdict.lines()[len(verdict.differs) :]
        if options.rerun and not differs:
            again = rerun(folder, options.inputs)
            differs += again.different
            lines.append(again.line())
    for line in differs:
        say(f"{options.folder}: {line}")
    for line in lines:
        print(f"{options.folder}: {line}")
    return 1 if differs else 0


def _report(options: argparse.Namespace) -> int:
    from tkamb.io.claim import claimed_directory, settle
    from tkamb.run.results_folder import REPORT_NAME, read_results
    from tkamb.show.report import write_report

    settle(options.folder)
    results = read_results(options.folder)  # an unreadable folder must stay unchanged
    with claimed_directory(options.folder) as folder:
        write_report(results, folder / REPORT_NAME)
    print(f"report: {options.folder / REPORT_NAME}")
    return 0


def _methods(options: argparse.Namespace) -> int:
    from tkamb.run.results_folder import read_results
    from tkamb.show.sections import methods

    print(methods(read_results(options.folder).summary).text())
    return 0
