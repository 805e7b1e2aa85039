"""The live window's server: this machine only, and nothing but the page and its data."""

import json
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from tkamb.errors import InputError, TkambError
from tkamb.view.live import ContactSwitch

HOST = "127.0.0.1"
LARGEST_QUESTION = 10_000


class ViewServer:
    """Serves one page on the loopback address.

    Requests under another host name (DNS rebinding) or from another site are refused.

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
        content = {
            "/": ("text/html; charset=utf-8", html.encode()),
            "/scene.bin": ("application/octet-stream", packed),
        }

        class Handler(_Handler):
            pass

        Handler.content, Handler.switch = content, switch
        try:
            self._server = ThreadingHTTPServer((HOST, port), Handler)
        except OSError as error:
            raise InputError(f"cannot listen ({error})", f"{HOST}:{port}", "--port 0") from None
        self._server.daemon_threads = True
        own = self._server.server_address[1]
        Handler.names = {f"{name}:{own}" for name in (HOST, "localhost")}

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self._server.server_address[1]}/"

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

    def do_GET(self) -> None:
        if not self._own():
            self._send(HTTPStatus.FORBIDDEN, "text/plain", b"another host or site")
        elif self.path in self.content:
            self._send(HTTPStatus.OK, *self.content[self.path])
        else:
            self._send(HTTPStatus.NOT_FOUND, "text/plain", b"no such page")

    def do_POST(self) -> None:
        if not self._own():
            self._send(HTTPStatus.FORBIDDEN, "text/plain", b"another host or site")
            return
        try:
            answer = self._answer(self._asked())
        except (TkambError, ValueError, KeyError, TypeError) as error:
            self._send(HTTPStatus.BAD_REQUEST, "text/plain; charset=utf-8", str(error).encode())
            return
        self._send(HTTPStatus.OK, "application/octet-stream", answer)

    def _answer(self, asked: dict[str, Any]) -> bytes:
        if self.switch is not None and self.path == "/contact":
            return self.switch.answer(int(asked["frame"]), str(asked["model"]))
        if self.switch is not None and self.path == "/lattice":
            return self.switch.lattice()
        raise TkambError("no such question")

    def log_message(self, format: str, *args: Any) -> None:
        """Stay quiet."""

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
        return self.headers.get("Host") in self.names and (
            origin is None or origin.removeprefix("http://") in self.names
        )

    def _send(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(body)
