"""A browser without a window, spoken to over two pipes: for pictures, and for the tests.

Chrome's DevTools protocol with `--remote-debugging-pipe`: messages end with a zero byte, the
browser reads file descriptor 3 and writes 4. No port is opened.
Reference: https://chromedevtools.github.io/devtools-protocol/
"""

import base64
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Self

from tkamb.errors import ComputationError

NAMES = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "microsoft-edge",
)
SOFTWARE_GRAPHICS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
STEP = 0.05

AT_3_AND_4 = """
import fcntl, os, sys
ends = [fcntl.fcntl(int(end), fcntl.F_DUPFD, 10) for end in sys.argv[1:3]]
for end, place in zip(ends, (3, 4)):
    os.dup2(end, place)
os.execv(sys.argv[3], sys.argv[3:])
"""
"""Puts the pipes where the browser looks for them, and becomes the browser."""


def find_browser() -> str | None:
    """Return the path of a Chromium-like browser, or None."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


def require_browser() -> str:
    """Return the path of a Chromium-like browser.

    Raises:
        ComputationError: there is none.
    """
    program = find_browser()
    if program is None:
        raise ComputationError(
            "no browser found", mend="install chromium (Debian: apt install chromium)"
        )
    return program


class HeadlessBrowser:
    """One page of a headless Chromium with software graphics.

    Args:
        width: pixels.
        height: pixels.
        seconds: longest wait for an answer.

    Attributes:
        problems: console errors, exceptions and failed requests so far.
        requests: addresses that the page asked for.

    Raises:
        ComputationError: no browser, or it does not start.
    """

    def __init__(self, width: int = 1400, height: int = 900, seconds: float = 60.0) -> None:
        program = require_browser()
        self.problems: list[str] = []
        self.requests: list[str] = []
        self._seconds, self._number, self._rest = seconds, 0, b""
        self._answers: dict[int, Any] = {}
        self._profile = tempfile.TemporaryDirectory(prefix="tkamb-view-")
        self._start(program, width, height)
        target = self._ask("Target.createTarget", {"url": "about:blank"})["targetId"]
        attached = self._ask("Target.attachToTarget", {"targetId": target, "flatten": True})
        self._session = attached["sessionId"]
        for domain in ("Runtime", "Log", "Network", "Page"):
            self.command(f"{domain}.enable")
        self.command(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False},
        )

    _session: str | None = None

    def open(self, url: str) -> float:
        """Open a page of the viewer and return the seconds until it is ready.

        Raises:
            ComputationError: it does not become ready.
        """
        start = time.perf_counter()
        self.command("Page.navigate", {"url": url})
        while not self.evaluate("Boolean(document.body && document.body.dataset.ready)"):
            if time.perf_counter() - start > self._seconds:
                told = "; ".join(self.problems) or "no console message"
                raise ComputationError(f"the page is not ready after {self._seconds:g} s ({told})")
            time.sleep(STEP)
        return time.perf_counter() - start

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression; promises are awaited.

        Raises:
            ComputationError: it throws.
        """
        given = {"expression": expression, "returnByValue": True, "awaitPromise": True}
        found = self.command("Runtime.evaluate", given)
        if "exceptionDetails" in found:
            thrown = found["exceptionDetails"]
            words = thrown.get("exception", {}).get("description") or thrown.get("text")
            raise ComputationError(f"the page throws: {words}")
        return found["result"].get("value")

    def picture(self) -> bytes:
        """Return the page as PNG, once what was asked for is drawn."""
        self.evaluate(
            "new Promise((done) => requestAnimationFrame(() => "
            "requestAnimationFrame(() => done(true))))"
        )
        return base64.b64decode(self.command("Page.captureScreenshot", {"format": "png"})["data"])

    def command(self, method: str, given: dict[str, Any] | None = None) -> Any:
        """Send a DevTools command to the page and return its result."""
        return self._ask(method, given or {}, self._session)

    def close(self) -> None:
        """End the browser and remove its profile."""
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for end in (self._to, self._from):
            os.close(end)
        shutil.rmtree(self._profile.name, ignore_errors=True)
        self._profile.cleanup()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _start(self, program: str, width: int, height: int) -> None:
        theirs_in, self._to = os.pipe()
        self._from, theirs_out = os.pipe()
        sandbox = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
        arguments = [
            program,
            "--headless=new",
            "--remote-debugging-pipe",
            f"--user-data-dir={self._profile.name}",
            f"--window-size={width},{height}",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-dev-shm-usage",
            *SOFTWARE_GRAPHICS,
            *sandbox,
        ]
        places = [str(theirs_in), str(theirs_out)]
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", AT_3_AND_4, *places, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(theirs_in, theirs_out),
        )
        os.close(theirs_in)
        os.close(theirs_out)

    def _ask(self, method: str, given: dict[str, Any], session: str | None = None) -> Any:
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": given}
        if session:
            message["sessionId"] = session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + self._seconds
        while self._number not in self._answers:
            self._read(end - time.monotonic(), method)
        answer = self._answers.pop(self._number)
        if "error" in answer:
            raise ComputationError(f"the browser refuses {method}: {answer['error']['message']}")
        return answer["result"]

    def _read(self, seconds: float, method: str) -> None:
        ready, _, _ = select.select([self._from], [], [], max(seconds, 0.0))
        part = os.read(self._from, 1 << 20) if ready else b""
        if not part:
            why = "the browser ended" if ready else f"no answer in {self._seconds:g} s"
            raise ComputationError(f"{why} ({method})")
        *messages, self._rest = (self._rest + part).split(b"\0")
        for text in messages:
            self._take(json.loads(text))

    def _take(self, message: dict[str, Any]) -> None:
        if "id" in message:
            self._answers[message["id"]] = message
            return
        given, method = message.get("params", {}), message.get("method")
        if method == "Network.requestWillBeSent":
            self.requests.append(given["request"]["url"])
        elif method == "Network.loadingFailed":
            self.problems.append(f"request failed: {given.get('errorText')}")
        elif method == "Runtime.exceptionThrown":
            self.problems.append(str(given["exceptionDetails"].get("exception", given)))
        elif method == "Runtime.consoleAPICalled" and given["type"] in ("error", "assert"):
            self.problems.append(" ".join(str(a.get("value", a)) for a in given["args"]))
        elif method == "Log.entryAdded" and given["entry"]["level"] == "error":
            self.problems.append(given["entry"]["text"])


def take_picture(page: Path, size: tuple[int, int] = (1400, 900), options: str = "") -> bytes:
    """Return a PNG of a page that stands by itself; `options` as after # in its address.

    Raises:
        ComputationError: no browser, or the page fails.
    """
    with HeadlessBrowser(*size) as browser:
        browser.open(f"{page.absolute().as_uri()}#{options}")
        return browser.picture()
