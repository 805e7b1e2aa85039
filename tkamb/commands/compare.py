"""`tkamb compare`: arguments in, exit status out."""

import argparse
import json
from pathlib import Path
from typing import Any

PAGE_NAME = "compare.html"


def add_compare(commands: Any) -> None:
    """Add `compare` to the command line."""
    compare = commands.add_parser("compare", help="two or more folders of results, side by side")
    compare.add_argument(
        "folders", type=Path, nargs="+", metavar="DIR", help="that `tkamb run` wrote; two or more"
    )
    compare.add_argument(
        "--axis",
        choices=("flexion", "cycle", "time"),
        help="common axis; default: the one that all of them ask for",
    )
    compare.add_argument(
        "--frame",
        type=int,
        metavar="K",
        help="of the first run: maps there; default: largest force",
    )
    compare.add_argument(
        "--out", type=Path, metavar="DIR", help=f"folder of {PAGE_NAME}; default out/compare"
    )
    compare.add_argument("--force", action="store_true", help="write into a folder not tkamb's")
    compare.add_argument("--json", action="store_true", help="print the differences as JSON")
    compare.set_defaults(command=_compare)


def _compare(options: argparse.Namespace) -> int:
    from tkamb.atomic import write_text
    from tkamb.io.claim import claimed_directory
    from tkamb.show.compare.comparison import compare_folders
    from tkamb.show.compare.page import comparison_html, table_lines

    result = compare_folders(options.folders, options.axis)
    html = comparison_html(result, options.frame)
    place = options.out or Path("out") / "compare"
    with claimed_directory(place, options.force) as folder:
        write_text(folder / PAGE_NAME, html)
    lines = [*table_lines(result), f"page: {folder / PAGE_NAME}"]
    text = json.dumps(result.as_dict(), indent=2) if options.json else "\n".join(lines)
    print(text)
    return 0
