"""`tkamb view`: arguments in, exit status out."""

import argparse
import sys
from pathlib import Path
from typing import Any

from tkamb.view.cameras import CAMERAS


def add_view(commands: Any) -> None:
    """Add `view` to the command line."""
    view = commands.add_parser("view", help="see a run and turn it around")
    view.add_argument(
        "runs",
        type=Path,
        nargs="+",
        metavar="SCENE|RESULTS",
        help="scene.toml or a folder that `tkamb run` wrote; several: side by side",
    )
    view.add_argument(
        "--contact",
        action="append",
        default=[],
        metavar="NAME",
        help="contact model of a scene; several: side by side",
    )
    view.add_argument("--frame", type=int, default=0, metavar="K", help="shown first")
    view.add_argument("--camera", default="oblique", metavar="NAME", help=", ".join(CAMERAS))
    view.add_argument("--lattice", action="store_true", help="draw the lattice too")
    view.add_argument("--html", type=Path, metavar="F", help="write one file instead of a window")
    view.add_argument("--png", type=Path, metavar="F", help="write a picture of the frame")
    view.add_argument("--port", type=int, default=0, help="of the live window; default: any free")
    view.set_defaults(command=_view)


def _view(options: argparse.Namespace) -> int:
    def announce(line: str) -> None:
        print(f"tkamb: {line}", file=sys.stderr, flush=True)

    announce(f"reading {', '.join(map(str, options.runs))}")
    from tqdm import tqdm

    from tkamb.view.run import open_run
    from tkamb.view.show import Show

    def progress(frames: Any) -> Any:
        return tqdm(frames, "drawing", unit="frame", disable=None)

    runs = [
        open_run(path, contact=contact, progress=progress, announce=announce)
        for path in options.runs
        for contact in options.contact or [None]
    ]
    show = Show(
        runs,
        frame=options.frame,
        camera=options.camera,
        lattice=options.lattice,
        progress=progress,
    )
    if options.html:
        show.write_html(options.html)
    if options.png:
        show.write_png(options.png)
    if not (options.html or options.png):
        show.open(announce, options.port)
    return 0
