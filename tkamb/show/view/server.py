"""The server of the viewer's window, and contact of one frame by another model on request.

The server accepts connections from this machine alone, and sends only the page and its data. Other
users of the machine can connect too. Therefore every address begins with a random token, which
only the user's terminal shows.
"""

import argparse
import json
import secrets
import sys
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Lock
from typing import Any

import numpy as np

from tkamb.contact.registry import contact_model_in_mm, contact_names
from tkamb.errors import InputError, TkambError
from tkamb.run.guard import say, unforeseen_words
from tkamb.run.recording import Recording
from tkamb.show.style import SIDE_COLOURS
from tkamb.show.view.draw import lattice_lines
from tkamb.show.view.drawing import PressureMap
from tkamb.show.view.payload import packed_lattice, packed_map
from tkamb.show.view.run import CaseResults
from tkamb.units import MEGAPASCAL, MILLIMETRE

HOST = "127.0.0.1"


# Largest number of bytes of a request; a longer request is refused. The page's
# requests are far shorter.
MOST_REQUEST_BYTES = 10_000
# s: a connection is closed if its client sends no byte for this time. A browser
# sends its request at once.
IDLE_SECONDS = 15.0
# Largest number of characters of a text answer; the rest is cut off. A page can
# show this many.
LONGEST_LINE = 2000
# Number of random bytes of the token in the address. Nobody can guess it.
TOKEN_BYTES = 18


HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "Connection": "close",
}
"""Headers of every answer. The policy inside the page limits what it may load
(`tkamb.show.view.page.POLICY`). Only a header can limit which sites may embed the page."""


class ContactSwitch:
    """Contact of a frame of a run by any contact model. Each model is prepared once.

    Only the latest request is answered. A newer request, or `cancel`, ends the earlier ones after
    their current step.

    Args:
        peak: top of the colour scale of the page, MPa.

    Attributes:
        stage: name of the current step; empty if no request is computed.
    """

    def __init__(self, run: CaseResults, peak: float) -> None:
        self.run, self.peak = run, peak
        self.stage = ""
        self._recordings: dict[str, Recording] = {}
        self._lock, self._counting, self._latest = Lock(), Lock(), 0

    def models(self) -> tuple[str, ...]:
        """Return the names of the available contact models; empty without [contact]."""
        return contact_names() if self.run.case.scene.contact else ()

    def answer(self, row: int, model: str) -> bytes:
        """Return the pressure map and its legend for one frame, compressed.

        Raises:
            TkambError: the model or frame does not exist, the model cannot be prepared, or a newer
                request arrived.
        """
        if not 0 <= row < len(self.run.frames):
            raise TkambError(f"there is no frame {row}")
        number = self.cancel()
        with self._lock:
            try:
                self._go_on(number, f"preparing {model}")
                recording = self._recording(model)
                self._go_on(number, f"computing frame {row} with {model}")
                return self._compute(recording, row, model)
            finally:
                self.stage = ""

    def cancel(self) -> int:
        """Cancel earlier requests; return the number of the next request."""
        with self._counting:
            self._latest += 1
            return self._latest

    def _go_on(self, number: int, stage: str) -> None:
        if number != self._latest:
            raise TkambError("cancelled")
        self.stage = stage

    def lattice(self) -> bytes:
        """Return the edges of the run's lattice, compressed.

        Raises:
            TkambError: the insert cannot be meshed.
        """
        with self._lock:
            return packed_lattice(lattice_lines(self.run.case))

    def _compute(self, recording: Recording, row: int, model: str) -> bytes:
        frame, contact = recording.frame(self.run.frames[row]), recording.knee.contact
        assert contact is not None
        points, triangles = contact.state.points, contact.state.triangles
        result = frame.contact
        if result is None:
            no_pressure = PressureMap(points, triangles, *np.zeros((2, 1, len(points))))
            return packed_map(no_pressure, self.peak, f"{model}: {frame.problem}")
        pressure_map = PressureMap(
            points, triangles, result.pressure[None] / MEGAPASCAL, result.gap[None]
        )
        parts = []
        for name in SIDE_COLOURS:
            condyle = getattr(result, name)
            if condyle is not None:
                parts.append(
                    f"{name} {condyle.force:.0f} N on {condyle.area / MILLIMETRE**2:.0f} mm², "
                    f"peak {condyle.peak_pressure / MEGAPASCAL:.1f} MPa"
                )
        words = [f"{model}: {'; '.join(parts)}", f"{frame.contact_seconds:.2f} s", *frame.flags]
        if pressure_map.peak > self.peak:
            words.append(f"the map exceeds the colour scale ({self.peak:.1f} MPa)")
        return packed_map(pressure_map, self.peak, "; ".join(words))

    def _recording(self, model: str) -> Recording:
        if model not in self._recordings:
            table = self.run.case.scene.contact
            assert table is not None
            options = table.options if model == table.model else {}
            other = contact_model_in_mm(model, table.resolution_mm, options)
            recording = self.run.recording.with_contact(other)
            recording.method.prepare()
            self._recordings[model] = recording
        return self._recordings[model]


class NotYet(TkambError):
    """The contact model is still being prepared; the page repeats its request."""


class ViewServer:
    """Server of one page on the loopback address.

    The server refuses requests under another host name (DNS rebinding), from another site, or
    without the token in their address.

    Args:
        switch: source of results by other contact models; None: the page has only the drawings.
        port: port of the server; 0: any free port.
        bench: function that returns the answer to a request of `tkamb live` from its name and
            content; None: the page is not that of `tkamb live`.
    """

    def __init__(
        self,
        html: str,
        packed: bytes,
        switch: ContactSwitch | None,
        port: int = 0,
        bench: "Callable[[str, dict[str, Any]], bytes] | None" = None,
    ) -> None:
        self.switch = switch
        self._token = secrets.token_urlsafe(TOKEN_BYTES)
        content = {
            "": ("text/html; charset=utf-8", html.encode()),
            "scene.bin": ("application/octet-stream", packed),
        }

        class Handler(_Handler):
            pass

        Handler.content, Handler.switch, Handler.root = content, switch, f"/{self._token}/"
        Handler.bench = None if bench is None else staticmethod(bench)
        try:
            self._server = _QuietServer((HOST, port), Handler)
        except (OSError, OverflowError) as error:
            raise InputError(f"cannot listen ({error})", f"{HOST}:{port}", "--port 0") from None
        self._server.daemon_threads = True
        bound_port = self._server.server_address[1]
        Handler.names = {f"{name}:{bound_port}" for name in (HOST, "localhost")}

    @property
    def url(self) -> str:
        """Return the address of the page with its token."""
        return f"http://{HOST}:{self._server.server_address[1]}/{self._token}/"

    def _repr_html_(self) -> str:
        return f'<a href="{self.url}" target="_blank" rel="noopener">{self.url}</a>'

    def serve(self) -> None:
        """Answer requests until `close`, or until the user interrupts."""
        self._server.serve_forever(poll_interval=0.2)

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._server.server_close()


class _QuietServer(ThreadingHTTPServer):
    """A server that ignores disconnected clients, for example a closed browser."""

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report an unexpected error in one line; ignore clients that have disconnected."""
        error = sys.exception()
        if isinstance(error, Exception) and not isinstance(error, ConnectionError | TimeoutError):
            say(unforeseen_words(error, argparse.Namespace()))


class _Handler(BaseHTTPRequestHandler):
    content: dict[str, tuple[str, bytes]]
    switch: ContactSwitch | None
    bench: "Callable[[str, dict[str, Any]], bytes] | None"
    names: set[str]
    root: str

    timeout = IDLE_SECONDS

    def parse_request(self) -> bool:
        """Refuse requests of HTTP/0.9, whose answers have no headers."""
        good = super().parse_request()
        if good and self.request_version == "HTTP/0.9":
            self.send_error(HTTPStatus.HTTP_VERSION_NOT_SUPPORTED)
            return False
        return good

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer a request that `http.server` refuses, with one line and all headers."""
        self.request_version = "HTTP/1.0"
        self.close_connection = True
        status = HTTPStatus(code)
        self._send_line(status, status.phrase)

    def do_GET(self) -> None:
        if not self._is_allowed():
            self._refuse()
        elif self._path_below_token in self.content:
            self._send(HTTPStatus.OK, *self.content[self._path_below_token])
        else:
            self._send_line(HTTPStatus.NOT_FOUND, "no such page")

    def do_POST(self) -> None:
        if not self._is_allowed():
            self._refuse()
            return
        try:
            answer = self._answer(self._read_request())
        except NotYet as error:
            self._send_line(HTTPStatus.ACCEPTED, error.what)
        except TimeoutError:
            self._send_line(HTTPStatus.REQUEST_TIMEOUT, "the request did not arrive")
        except (TkambError, ValueError, KeyError, RecursionError) as error:
            self._send_line(HTTPStatus.BAD_REQUEST, str(error) or type(error).__name__)
        except Exception as error:  # the page shows the error, and the server continues
            words = f"{type(error).__name__}: {error}"
            self._send_line(HTTPStatus.INTERNAL_SERVER_ERROR, words)
        else:
            self._send(HTTPStatus.OK, "application/octet-stream", answer)

    def _answer(self, content: dict[str, Any]) -> bytes:
        if self.bench is not None:
            return self.bench(self._path_below_token, content)
        if self.switch is not None and self._path_below_token == "contact":
            frame, model = content["frame"], content["model"]
            if type(frame) is not int or not isinstance(model, str):
                raise TkambError("'frame' must be an integer, and 'model' a name")
            return self.switch.answer(frame, model)
        if self.switch is not None and self._path_below_token == "lattice":
            return self.switch.lattice()
        if self.switch is not None and self._path_below_token == "stage":
            return self.switch.stage.encode()
        if self.switch is not None and self._path_below_token == "cancel":
            self.switch.cancel()
            return b""
        raise TkambError("no such request")

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing."""

    @property
    def _path_below_token(self) -> str:
        """Return the part of the path after the token."""
        return self.path.removeprefix(self.root)

    def _read_request(self) -> dict[str, Any]:
        length = int(self.headers.get("Content-Length") or 0)
        if not 0 < length <= MOST_REQUEST_BYTES:
            raise TkambError("the request has no bytes, or too many")
        content = json.loads(self.rfile.read(length))
        if not isinstance(content, dict):
            raise TkambError("the request must be a JSON object")
        return content

    def _is_allowed(self) -> bool:
        origin = self.headers.get("Origin")
        path_start = self.path[: len(self.root)].encode(errors="replace")
        return (
            self.headers.get("Host") in self.names
            and (origin is None or origin in {f"http://{name}" for name in self.names})
            and secrets.compare_digest(path_start, self.root.encode())
        )

    def _refuse(self) -> None:
        self._send_line(
            HTTPStatus.FORBIDDEN, "another host or site, or not the address tkamb printed"
        )

    def _send_line(self, status: HTTPStatus, words: str) -> None:
        line = " ".join(words.split())[:LONGEST_LINE]
        # a name in the request may contain characters that UTF-8 cannot encode
        self._send(status, "text/plain; charset=utf-8", line.encode(errors="backslashreplace"))

    def _send(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)
