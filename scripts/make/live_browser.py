"""The page of `tkamb live` in a headless browser, for measurements and pictures."""

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from tkamb.show.view.live_window import LiveWindow, open_live
from tkamb.show.view.page import SOFTWARE_GRAPHICS, find_browser
from tkamb.show.view.server import ViewServer
from tkamb.show.view.show import serve_in_background

SCENE = Path(__file__).resolve().parents[2] / "models" / "deep_knee_bend" / "scene.toml"
IDLE = "!tkamb.bench.busy && !tkamb.bench.waiting && !tkamb.bench.timer"
PATIENCE_S = 1800.0


@contextmanager
def browser_page(width: int, height: int) -> Iterator[Page]:
    """Yield an empty page of a size in pixels."""
    with sync_playwright() as driver:
        arguments = [*SOFTWARE_GRAPHICS, "--no-sandbox"]
        browser = driver.chromium.launch(executable_path=find_browser(), args=arguments)
        yield browser.new_page(viewport={"width": width, "height": height})
        browser.close()


@contextmanager
def live_page(page: Page, spacing_mm: float) -> Iterator[LiveWindow]:
    """Open the shipped knee with the lattice, and wait for its first fine answer."""
    with tempfile.TemporaryDirectory() as folder:
        window = open_live(SCENE, frame=60, contact="lattice", folder=Path(folder))
        window.set_resolution(spacing_mm)
        server: ViewServer = window.server()
        serve_in_background(server)
        page.goto(server.url)
        wait_until(page, "document.body.dataset.ready === 'yes' && tkamb.bench.reference")
        wait_until(page, IDLE)
        yield window
        server.close()


def wait_until(page: Page, condition: str) -> None:
    """Poll a condition, because the page's policy forbids the browser's own wait."""
    end = time.monotonic() + PATIENCE_S
    while not page.evaluate(f"() => Boolean({condition})"):
        if time.monotonic() > end:
            raise SystemExit(f"not reached in {PATIENCE_S:g} s: {condition}")
        time.sleep(0.05)
