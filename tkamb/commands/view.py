"""`tkamb view` shows runs in 3D; `tkamb live` moves and presses a knee by sliders."""

import argparse
import os
from pathlib import Path
from typing import Any

from tkamb.commands.options import option
from tkamb.errors import InputError
from tkamb.io.claim import check_output_file
from tkamb.run.guard import say
from tkamb.show.view import CAMERAS

HIGHEST_PORT = 65535


def add_view(commands: Any) -> None:
    """Add `view` to the command line."""
    view = commands.add_parser("view", help="show a run in 3D")
    view.add_argument(
        "runs",
        type=Path,
        nargs="+",
        metavar="SCENE|RESULTS",
        help="scene.toml or a folder that `tkamb run` wrote; several are shown side by side",
    )
    option(
        view,
        "--contact NAME",
        "contact model of a scene; several are shown side by side",
        action="append",
        default=[],
    )
    option(view, "--frame K", "first frame that is shown", int, default=0)
    option(view, "--camera NAME", ", ".join(CAMERAS), default="oblique")
    option(view, "--lattice", "draw the lattice, too")
    option(view, "--html F", "write one HTML file instead of a window", Path)
    option(view, "--png F", "write a picture of the frame", Path)
    for kind in ("gif", "mp4"):
        option(view, f"--{kind} F", "write all frames as a film (extra: film)", Path)
    option(view, "--force", "write over files that tkamb did not write")
    option(view, "--port PORT", "port of the window; default: any free port", int, default=0)
    view.set_defaults(command=_view)


def _view(options: argparse.Namespace) -> int:
    _check(options)
    say(f"reading {', '.join(map(str, options.runs))}")
    from tqdm import tqdm

    from tkamb.show.view.run import check_frame, read_source
    from tkamb.show.view.show import Show

    def progress(frames: Any) -> Any:
        return tqdm(frames, "drawing", unit="frame", disable=None)

    sources = [
        read_source(path, contact) for path in options.runs for contact in options.contact or [None]
    ]
    check_frame(sources, options.frame)
    runs = [source.open(progress, say) for source in sources]
    show = Show(
        runs,
        frame=options.frame,
        camera=options.camera,
        lattice=options.lattice,
        progress=progress,
    )
    if options.html:
        show.write_html(options.html)
        print(f"page: {options.html}")
    if options.png:
        show.write_png(options.png)
        print(f"picture: {options.png}")
    films = [path for path in (options.gif, options.mp4) if path]
    for path in films:
        from tkamb.show.view.page import write_film

        write_film(show, path, lambda frames: tqdm(frames, "filming", unit="frame", disable=None))
        print(f"film: {path}")
    if not (options.html or options.png or films):
        show.open(say, options.port)
    return 0


def _check(options: argparse.Namespace) -> None:
    check_port(options.port)
    if options.camera not in CAMERAS:
        hint = f"there are: {', '.join(CAMERAS)}"
        raise InputError(f"no view '{options.camera}'", "--camera", hint)
    if options.contact:
        from tkamb.contact.registry import contact_class

        for name in options.contact:
            contact_class(name)
        for path in options.runs:
            if os.path.isdir(path):
                raise InputError(
                    "has its own contact model", path, "give the scene to choose another"
                )
    for path in (options.html, options.png, options.gif, options.mp4):
        if path is not None and not os.access(path.absolute().parent, os.W_OK):
            raise InputError("cannot be written (no such folder, or not yours)", path)
        check_output_file(path, options.force)
    for kind in ("gif", "mp4"):
        if path := getattr(options, kind):
            from tkamb.show.view.page import check_film

            check_film(path, f"--{kind}")
    if options.png:
        from tkamb.show.view.page import find_browser

        find_browser()


def check_port(port: int) -> None:
    """Raise an InputError unless a port is 0 to 65535."""
    if not 0 <= port <= HIGHEST_PORT:
        raise InputError(f"no port {port}", "--port", f"give 0 (any) to {HIGHEST_PORT}")


def add_live(commands: Any) -> None:
    """Add `live` to the command line."""
    live = commands.add_parser(
        "live",
        help="move and press a knee by sliders in a window",
    )
    live.add_argument(
        "path",
        type=Path,
        metavar="SCENE|RESULTS",
        help="scene.toml or a folder that `tkamb run` wrote",
    )
    option(live, "--frame K", "first recorded frame that is shown", int, default=0)
    option(live, "--contact NAME", "contact model, instead of the scene's")
    option(live, "--out DIR", "folder for saved scenes; default: out/live", Path)
    option(live, "--port PORT", "port of the window; default: any free port", int, default=0)
    live.set_defaults(command=_live)


def _live(options: argparse.Namespace) -> int:
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
