"""The live window's server: this machine only, and nothing but the page and its data.

Other users of the machine reach the port too: every address starts with a random token, which
only the user's terminal shows.
"""

import json
import secrets
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from tkamb.errors import InputError, TkambError
from tkamb.view.live import ContactSwitch

HOST = "127.0.0.1"
LARGEST_QUESTION = 10_000
LONGEST_SILENCE = 15.0
"""s: without a byte from a client that is connected, before it is cut off."""
TOKEN_BYTES = 18
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "Connection": "close",
}
"""Of every answer. The page's own policy says what it may load (`tkamb.view.page.POLICY`); who may
frame it can only be said here."""


class ViewServer:
    """Serves one page on the loopback address.

    Requests under another host name (DNS rebinding), from another site, or without the token in
    their address are refused.

    Args:
        html: the page.
        packed: the drawings.
        switch: computes other contact models; None without.
        port: 0 for any free one.

    Raises:
        InputError: the port is taken.
    """

    def __init__(
        self, html: str, packed: bytes, switch: ContactSwitch | None, port: int = 0
    ) -> None:
        self._token = secrets.token_urlsafe(TOKEN_BYTES)
        content = {
            "": ("text/html; charset=utf-8", html.encode()),
            "scene.bin": ("application/octet-stream", packed),
        }

        class Handler(_Handler):
            pass

        Handler.content, Handler.switch, Handler.root = content, switch, f"/{self._token}/"
        try:
            self._server = ThreadingHTTPServer((HOST, port), Handler)
        except (OSError, OverflowError) as error:
            raise InputError(f"cannot listen ({error})", f"{HOST}:{port}", "--port 0") from None
        self._server.daemon_threads = True
        own = self._server.server_address[1]
        Handler.names = {f"{name}:{own}" for name in (HOST, "localhost")}

    @property
    def url(self) -> str:
        """Address of the page, token included."""
        return f"http://{HOST}:{self._server.server_address[1]}/{self._token}/"

    def serve(self) -> None:
        """Answer until `close`, or until the user interrupts."""
        self._server.serve_forever(poll_interval=0.2)

    def close(self) -> None:
        """Stop."""
        self._server.shutdown()
        self._server.server_close()


class _Handler(BaseHTTPRequestHandler):
    content: dict[str, tuple[str, bytes]]
    switch: ContactSwitch | None
    names: set[str]
    root: str

    timeout = LONGEST_SILENCE

    def do_GET(self) -> None:
        if not self._own():
            self._refuse()
        elif self._asked_for in self.content:
            self._send(HTTPStatus.OK, *self.content[self._asked_for])
        else:
            self._say(HTTPStatus.NOT_FOUND, "no such page")

    def do_POST(self) -> None:
        if not self._own():
            self._refuse()
            return
        try:
            answer = self._answer(self._asked())
        except TimeoutError:
            self._say(HTTPStatus.REQUEST_TIMEOUT, "the question did not arrive")
        except (TkambError, ValueError, KeyError, RecursionError) as error:
            self._say(HTTPStatus.BAD_REQUEST, str(error) or type(error).__name__)
        except Exception as error:  # the last handler: the window says it, the server goes on
            words = f"{type(error).__name__}: {error}"
            self._say(HTTPStatus.INTERNAL_SERVER_ERROR, words)
        else:
            self._send(HTTPStatus.OK, "application/octet-stream", answer)

    def _answer(self, asked: dict[str, Any]) -> bytes:
        if self.switch is not None and self._asked_for == "contact":
            frame, model = asked["frame"], asked["model"]
            if type(frame) is not int or not isinstance(model, str):
                raise TkambError("frame is an integer, model a name")
            return self.switch.answer(frame, model)
        if self.switch is not None and self._asked_for == "lattice":
            return self.switch.lattice()
        raise TkambError("no such question")

    def log_message(self, format: str, *args: Any) -> None:
        """Stay quiet."""

    @property
    def _asked_for(self) -> str:
        """The path below the token."""
        return self.path.removeprefix(self.root)

    def _asked(self) -> dict[str, Any]:
        length = int(self.headers.get("Content-Length") or 0)
        if not 0 < length <= LARGEST_QUESTION:
            raise TkambError("a question of no or too many bytes")
        asked = json.loads(self.rfile.read(length))
        if not isinstance(asked, dict):
            raise TkambError("a question is an object")
        return asked

    def _own(self) -> bool:
        origin = self.headers.get("Origin")
        given = self.path[: len(self.root)].encode(errors="replace")
        return (
            self.headers.get("Host") in self.names
            and (origin is None or origin.removeprefix("http://") in self.names)
            and secrets.compare_digest(given, self.root.encode())
        )

    def _refuse(self) -> None:
        self._say(HTTPStatus.FORBIDDEN, "another host or site, or not the address tkamb printed")

    def _say(self, status: HTTPStatus, words: str) -> None:
        """Send one line of text."""
        self._send(status, "text/plain; charset=utf-8", " ".join(words.split()).encode())

    def _send(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)
