"""`tkamb export`: a folder of results in other programs' formats."""

import argparse
from pathlib import Path
from typing import Any


def add_export(commands: Any) -> None:
    """Add the command `export` to the parser's commands."""
    export = commands.add_parser("export", help="results for other programs")
    export.add_argument("folder", type=Path, metavar="DIR")
    kind = export.add_mutually_exclusive_group(required=True)
    kind.add_argument("--sto", type=Path, metavar="F.sto", help="all columns, for OpenSim")
    export.set_defaults(command=_export)


def _export(options: argparse.Namespace) -> int:
    from tkamb.output.storage import write_results_storage
    from tkamb.results_folder import read_results

    results = read_results(options.folder)
    print(f"{options.sto}: {write_results_storage(results, options.sto)}")
    return 0
