"""The page around the scene, one HTML that needs nothing from elsewhere, and a picture of it."""

import base64
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import meshcat

from tkamb.errors import ComputationError
from tkamb.show.pages import asset, policy_sources, render

PACKAGE = "tkamb.show.view"
SCRIPTS = ("scene.js", "moving.js", "controls.js", "start.js")
POLICY = (
    "default-src 'none'; script-src {scripts}; style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src {connect}; base-uri 'none'; form-action 'none'"
)
"""The browser itself refuses any request to another place and any script but the page's own, by
their hashes; meshcat's viewer adds styles as it runs."""

BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "microsoft-edge",
)
SOFTWARE_GRAPHICS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@dataclass(frozen=True)
class PageSettings:
    """Pictures that a browser takes of the viewer page."""

    timeout: float = 120.0
    """s; a browser that takes longer has failed. Chosen: a usual page takes some seconds."""


PAGE = PageSettings()


def page_html(
    title: str,
    packed: bytes | None,
    *,
    frame: int = 0,
    view: str = "oblique",
    live: Sequence[str] | None = None,
) -> str:
    """Return the page.

    Args:
        title: heading.
        packed: the drawings (`tkamb.show.view.payload.pack`); None when a server gives them.
        frame: shown first.
        view: camera that is chosen first.
        live: contact models that the server can compute; None without a server.
    """
    # What stands between script tags must not hold the text that closes them.
    scripts = [
        "\n" + text.replace("</script", "<\\/script")
        for text in (meshcat_script(), *(asset(PACKAGE, name) for name in SCRIPTS))
    ]
    connect = "'none'" if live is None else "'self'"
    return render(
        PACKAGE,
        "page.html",
        title=title,
        policy=POLICY.format(scripts=policy_sources(*scripts), connect=connect),
        style=asset(PACKAGE, "style.css"),
        request={"frame": frame, "view": view, "live": live},
        data=None if packed is None else base64.b64encode(packed).decode(),
        scripts=scripts,
    )


def meshcat_script() -> str:
    """Return meshcat's viewer, three.js included, as its package ships it."""
    root = Path(meshcat.__file__).parent
    return (root / "viewer" / "dist" / "main.min.js").read_text(encoding="utf-8")


def find_browser() -> str:
    """Return the path of a Chromium-like browser.

    Raises:
        ComputationError: there is none.
    """
    result = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if result is None:
        raise ComputationError(
            "no browser found", hint="install chromium (Debian: apt install chromium)"
        )
    return result


def screenshot(html: str, size: tuple[int, int]) -> bytes:
    """Return a PNG of a page of `page_html` that stands by itself, without its controls.

    Args:
        html: the page.
        size: width and height in pixels.

    Raises:
        ComputationError: no browser, or the page does not become ready.
    """
    browser = find_browser()
    with tempfile.TemporaryDirectory(prefix="tkamb-view-", ignore_cleanup_errors=True) as folder:
        page, picture = Path(folder) / "page.html", Path(folder) / "picture.png"
        page.write_text(html, encoding="utf-8")
        command: list[Any] = [
            browser,
            "--headless=new",
            f"--user-data-dir={folder}/profile",
            f"--window-size={size[0]},{size[1]}",
            "--hide-scrollbars",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-dev-shm-usage",
            *SOFTWARE_GRAPHICS,
            *(["--no-sandbox"] if os.geteuid() == 0 else []),
            # The page unpacks its data after it is loaded: so much of its own time it is given.
            "--virtual-time-budget=20000",
            f"--screenshot={picture}",
            "--dump-dom",
            f"{page.as_uri()}#figure=1",
        ]
        try:
            process = subprocess.run(command, capture_output=True, timeout=PAGE.timeout)
        except subprocess.TimeoutExpired:
            raise ComputationError(f"no picture of the page in {PAGE.timeout:g} s") from None
        if b'data-ready="yes"' not in process.stdout or not picture.exists():
            raise ComputationError("the page could not be drawn", str(browser))
        return picture.read_bytes()
