"""Output of the viewer: a live window, an HTML file or a picture."""

import os
import sys
import threading
import webbrowser
from collections.abc import Callable, Sequence
from copy import copy
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from tkamb.errors import InputError, must_be
from tkamb.files import replaced_file, write_text
from tkamb.show.view import CAMERAS
from tkamb.show.view.draw import draw
from tkamb.show.view.drawing import Drawing
from tkamb.show.view.page import page_html, screenshot
from tkamb.show.view.payload import pack, peak_pressure
from tkamb.show.view.run import CaseResults, Progress, no_frame, run_of_results

if TYPE_CHECKING:
    from tkamb.run.results import Results
    from tkamb.show.view.server import ViewServer

Line = Callable[[str], None]


class Show:
    """Drawings of one or more runs, shown side by side.

    Args:
        frame: frame at which the page opens.
        lattice: whether the cells of the lattice are drawn too. The live window draws them when
            the user switches their layer on.
        progress: function that wraps the frame indices, for example a progress bar.
    """

    def __init__(
        self,
        runs: Sequence[CaseResults],
        *,
        frame: int = 0,
        camera: str = "oblique",
        lattice: bool = False,
        progress: Progress = lambda frames: frames,
    ) -> None:
        self.runs = tuple(runs)
        self.frame, self.camera = self._check(frame, camera)
        self.drawings: tuple[Drawing, ...] = tuple(draw(run, progress, lattice) for run in runs)
        if camera == "button" and self.drawings[0].button_map is None:
            raise InputError("has no map of the patellar button", "camera", "choose another view")
        self.packed = pack(self.drawings)
        self.title = " | ".join(drawing.title for drawing in self.drawings)

    def at(self, frame: int, camera: str) -> "Show":
        """Return the same drawings with another first frame and camera."""
        other = copy(self)
        other.frame, other.camera = self._check(frame, camera)
        return other

    def html(self) -> str:
        """Return the self-contained page."""
        return page_html(self.title, self.packed, frame=self.frame, view=self.camera)

    def write_html(self, path: str | Path) -> None:
        """Write the self-contained page."""
        write_text(Path(path), self.html())

    def write_png(self, path: str | Path, size: tuple[int, int] = (1400, 900)) -> None:
        """Write a picture of the frame, with colour bars and legend but without controls.

        Raises:
            ComputationError: no browser is installed.
            InputError: the folder cannot be written.
        """
        picture = screenshot(self.html(), size)
        with replaced_file(Path(path)) as temporary:
            temporary.write_bytes(picture)

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{escape(self.html())}" style="width:100%;height:640px;border:0">'
            "</iframe>"
        )

    def _check(self, frame: int, camera: str) -> tuple[int, str]:
        most = max(len(run.frames) for run in self.runs)
        if not -most <= frame < most:
            raise no_frame(frame, most)
        if camera not in CAMERAS:
            raise InputError(f"no view '{camera}'", "camera", f"there are: {', '.join(CAMERAS)}")
        return frame % most, camera

    def server(self, port: int = 0) -> "ViewServer":
        """Return the server of the live window, not yet started."""
        from tkamb.show.view.server import ContactSwitch, ViewServer

        switch = ContactSwitch(self.runs[0], peak_pressure(self.drawings))
        html = page_html(self.title, None, frame=self.frame, view=self.camera, live=switch.models())
        return ViewServer(html, self.packed, switch, port)

    def open(self, announce: Line, port: int = 0, browse: bool = True) -> None:
        """Serve the live window until the user interrupts."""
        server = self.server(port)
        announce(f"viewer: {server.url} (this machine only; Ctrl-C ends it)")
        if browse and not open_window(server.url):
            announce(
                "no window can be opened here: open that address in a browser, or use --html FILE"
            )
        server.serve()


def open_window(url: str) -> bool:
    """Open a window of the user's browser; return False if there is no browser or no display."""
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        return False
    return webbrowser.open(url)


def serve_in_background(server: "ViewServer") -> threading.Thread:
    """Start a server in a thread, for notebooks and tests."""
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    return thread


def show(results: "Results", frame: int = 0) -> Show:
    """Return the 3-D drawing of a run, which notebooks display.

    Args:
        results: results of a run.
        frame: frame at which the page opens.

    Raises:
        InputError: the scene is missing, or has changed since the run.
    """
    from tkamb.run.results import Results

    must_be(results, Results, "view", "give the results of a run")
    return Show([run_of_results(results)], frame=frame)
