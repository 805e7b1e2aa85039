"""`tkamb data`: its arguments, and what it prints."""

import argparse
from pathlib import Path
from typing import Any

from tkamb.io.datasets import NAMES, read_dataset


def add_data(commands: Any) -> None:
    """Add the command `data` to the parser's commands."""
    data = commands.add_parser("data", help="real data for the shipped scenes")
    verbs = data.add_subparsers(required=True, metavar="VERB")
    get = verbs.add_parser("get", help="download a data set, or take it from a folder")
    get.add_argument("name", choices=NAMES, help="dm: Grand Challenge subject DM")
    source = get.add_mutually_exclusive_group()
    source.add_argument(
        "--from", dest="source", type=Path, metavar="DIR", help="downloaded by hand"
    )
    source.add_argument("--url", metavar="URL", help="of a mirror with the same paths")
    get.add_argument(
        "--to",
        type=Path,
        metavar="DIR",
        help="default: ../shared/data/dm, where the scenes of models/dm look from the "
        "project's folder",
    )
    get.set_defaults(command=_get)


def _get(options: argparse.Namespace) -> int:
    from tkamb.io.datasets import download, take_from

    dataset = read_dataset(options.name)
    to = options.to or dataset.folder
    if options.source is not None:
        got = take_from(dataset, to, options.source)
        why = f"not in {options.source}"
    else:
        got = download(dataset, to, options.url)
        why = "their address is not known; no scene needs them; --from DIR copies them"
    print(f"{to}: {dataset.says} ({dataset.licence}, {dataset.repository})")
    print(f"  {len(got.written)} files written, {len(got.kept)} were there, each by its SHA-256")
    if got.absent:
        print(f"  not there ({why}): {', '.join(got.absent)}")
    return 0
