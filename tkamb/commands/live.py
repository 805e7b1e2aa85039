"""`tkamb live`: arguments in, exit status out."""

import argparse
from pathlib import Path
from typing import Any

from tkamb.run.guard import say


def add_live(commands: Any) -> None:
    """Add `live` to the command line."""
    live = commands.add_parser(
        "live",
        help="turn and press a knee by hand; contact is computed as sliders move",
    )
    live.add_argument(
        "path",
        type=Path,
        metavar="SCENE|RESULTS",
        help="scene.toml or a folder that `tkamb run` wrote",
    )
    live.add_argument("--frame", type=int, default=0, metavar="K", help="recorded frame at first")
    live.add_argument("--contact", metavar="NAME", help="contact model, instead of the scene's")
    live.add_argument("--out", type=Path, metavar="DIR", help="for kept scenes; default: out/live")
    live.add_argument("--port", type=int, default=0, help="of the window; default: any free")
    live.set_defaults(command=_live)


def _live(options: argparse.Namespace) -> int:
    from tkamb.commands.view import check_port
    from tkamb.show.view.live_window import open_live
    from tkamb.show.view.show import open_window

    check_port(options.port)
    say(f"reading {options.path}")
    window = open_live(
        options.path, frame=options.frame, contact=options.contact, folder=options.out
    )
    say("preparing contact")
    server = window.server(options.port)
    say(f"live: {server.url} (this machine only; Ctrl-C ends it)")
    if not open_window(server.url):
        say("no window can be opened here: open that address in a browser")
    server.serve()
    return 0
