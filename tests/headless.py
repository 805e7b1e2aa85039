"""Pages in a headless browser: playwright with an installed chromium."""

from contextlib import contextmanager
from pathlib import Path

import pytest

from tkamb.errors import ComputationError

READY = "document.body && document.body.dataset.ready"
"""JavaScript expression that is true after the viewer has drawn its page."""


@contextmanager
def chromium():
    """Yield a browser. The test is skipped if none is installed."""
    from tkamb.show.view.page import (  # not at the top, because conftest imports this file
        SOFTWARE_GRAPHICS,
        find_browser,
    )

    sync = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    try:
        path = find_browser()
    except ComputationError as error:
        pytest.skip(str(error))
    with sync.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(SOFTWARE_GRAPHICS))
        yield browser
        browser.close()


class Page:
    """A page of a browser.

    Attributes:
        problems: console errors, exceptions and failed requests so far.
        requests: addresses that the page has requested.
    """

    def __init__(self, browser):
        self.problems, self.requests = [], []
        self._page = browser.new_page(viewport={"width": 1400, "height": 900})
        self._page.on("request", lambda request: self.requests.append(request.url))
        self._page.on("requestfailed", lambda r: self.problems.append(f"{r.failure} {r.url}"))
        self._page.on("pageerror", lambda error: self.problems.append(str(error)))
        self._page.on("console", self._console)
        self.evaluate, self.close = self._page.evaluate, self._page.close

    def open(self, url, ready=READY):
        """Open an address and wait until a JavaScript expression is true."""
        self._page.goto(url)
        self.wait(ready)
        return self

    def wait(self, ready):
        """Wait until a JavaScript expression is true. After five minutes, fail and name it."""
        self.evaluate(
            "(ready) => new Promise((done, fail) => { let rounds = 0; const t = setInterval(() => {"
            f"if ({ready}) {{ clearInterval(t); done(true); }}"
            "else if (++rounds > 15000) "
            "{ clearInterval(t); fail(new Error('never true: ' + ready)); }"
            "}, 20); })",
            ready,
        )

    def forgive(self, words):
        """Wait for a console error that contains these words, and remove it from `problems`."""
        while not (awaited := [one for one in self.problems if words in one]):
            self._page.wait_for_event("console")
        self.problems.remove(awaited[0])

    def saved(self, selector):
        """Click on an element and return the bytes of the file that the page saves."""
        with self._page.expect_download() as download:
            self._page.click(selector)
        return Path(download.value.path()).read_bytes()

    def resize(self, width, height):
        """Set the size of the window, px, and wait until the page has drawn it."""
        self._page.bring_to_front()  # a page behind another one is not drawn
        self._page.set_viewport_size({"width": width, "height": height})
        self.evaluate("new Promise((done) => requestAnimationFrame(() => setTimeout(done, 50)))")

    def press(self, key):
        """Press a key. The focused element receives it."""
        self._page.keyboard.press(key)

    def pdf(self):
        """Return the bytes of the page printed as PDF."""
        return self._page.pdf(prefer_css_page_size=True)

    def _console(self, message):
        if message.type in ("error", "assert"):
            self.problems.append(message.text)
