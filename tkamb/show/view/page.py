"""The viewer as one self-contained HTML page, and pictures and films of it by a browser."""

import base64
import io
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import meshcat
import numpy as np
from PIL import Image

from tkamb.errors import ComputationError, InputError, not_installed
from tkamb.files import replaced_file
from tkamb.show.pages import asset, policy_sources, render
from tkamb.show.view.run import Progress

if TYPE_CHECKING:
    from tkamb.show.view.show import Show


SIZE = (1280, 720)
"""Width and height of pictures, pixels. MP4 needs even numbers."""


# Largest number of frames per second. Browsers play no GIF faster.
MAX_FRAME_RATE = 50.0


READY = (
    "new Promise((done, fail) => { setTimeout(() => fail('not drawn in 60 s'), 60000); "
    "setInterval(() => document.body.dataset.ready && done(), 20); })"
)
"""Script that waits until the page is drawn. The page's security policy blocks the wait function of
the browser driver."""
INSTALL = "install chromium (Debian: apt install chromium)"


def check_film(path: Path, option: str) -> None:
    """Raise an InputError if this machine cannot make a film. Call it before any drawing.

    Args:
        path: path of the film, .gif or .mp4.
    """
    if path.suffix.lower() != f".{option.removeprefix('--')}":
        raise InputError(f"'{path.name}' does not end with .{option.removeprefix('--')}", option)
    try:
        find_browser()
    except ComputationError as error:
        raise InputError(str(error).split("; ")[0], option, INSTALL) from None
    _playwright()
    if path.suffix.lower() == ".mp4":
        _encoder()


def write_film(show: "Show", path: Path, progress: Progress = lambda frames: frames) -> None:
    """Write a film of every frame at the speed of the motion.

    Args:
        path: path of the film, .gif or .mp4.
        progress: function that wraps the frame indices, for example a progress bar.

    Raises:
        InputError: a package or browser is missing, or the folder cannot be written.
        ComputationError: the page is not drawn, or the encoder fails.
    """
    times = max((one.times for one in show.drawings), key=len)
    rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 1.0
    rate = float(np.clip(rate, 1.0, MAX_FRAME_RATE))
    pictures = film_frames(show.html(), len(times), progress)
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    with replaced_file(path) as temporary:
        write(pictures, temporary, rate)


def film_frames(html: str, count: int, progress: Progress) -> Iterator[bytes]:
    """Yield a PNG of each frame of a page of `page_html`, without its controls."""
    with tempfile.TemporaryDirectory(prefix="tkamb-film-") as folder, _playwright()() as driver:
        page_path = Path(folder) / "page.html"
        page_path.write_text(html, encoding="utf-8")
        browser = driver.chromium.launch(
            executable_path=find_browser(), args=list(SOFTWARE_GRAPHICS)
        )
        try:
            page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
            page.goto(f"{page_path.as_uri()}#figure=1")
            page.evaluate(READY)
            for k in progress(range(count)):
                page.evaluate(f"tkamb.go({k}); tkamb.viewer.render()")
                yield page.screenshot()
        finally:
            browser.close()


def _write_gif(pictures: Iterator[bytes], path: Path, rate: float) -> None:
    """Write a GIF. The 256 colours of each picture are spread evenly over its range of colours.

    The usual choice of the most frequent colours would give mostly greys of the background.
    """
    spread, plain = Image.Quantize.MAXCOVERAGE, Image.Dither.NONE
    first, *rest = (
        Image.open(io.BytesIO(one)).convert("RGB").quantize(256, method=spread, dither=plain)
        for one in pictures
    )
    duration = round(1e3 / rate)
    first.save(path, "GIF", save_all=True, append_images=rest, duration=duration, loop=0)


def _write_mp4(pictures: Iterator[bytes], path: Path, rate: float) -> None:
    command = [
        _encoder(), "-v", "error", "-y", "-f", "image2pipe", "-framerate", f"{rate:.4f}",
        "-c:v", "png", "-i", "-", "-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p",
        "-movflags", "+faststart", "-f", "mp4", str(path),
    ]  # fmt: skip
    process = subprocess.run(command, input=b"".join(pictures), capture_output=True)
    if process.returncode:
        raise ComputationError(f"ffmpeg failed ({process.stderr.decode(errors='replace').strip()})")


def _playwright() -> Any:
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise not_installed("playwright", "a film", "film") from None
    return sync_playwright


def _encoder() -> str:
    """Return the path of ffmpeg, installed on the machine or by the extra."""
    result = shutil.which("ffmpeg")
    if result is not None:
        return result
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError:
        raise not_installed("imageio-ffmpeg", "an .mp4", "film") from None
    return str(get_ffmpeg_exe())


PACKAGE = "tkamb.show.view"
SCRIPTS = ("scene.js", "moving.js", "controls.js", "start.js")
POLICY = (
    "default-src 'none'; script-src {scripts}; style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src {connect}; base-uri 'none'; form-action 'none'"
)
"""The browser refuses requests to other hosts, and scripts without one of these hashes. Inline
styles are allowed, because meshcat's viewer adds them."""

BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "microsoft-edge",
)
SOFTWARE_GRAPHICS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


# s: time limit of the browser. A page usually takes some seconds.
TIMEOUT = 120.0


def page_html(
    title: str,
    packed: bytes | None,
    *,
    frame: int = 0,
    view: str = "oblique",
    live: Sequence[str] | None = None,
) -> str:
    """Return the HTML page of the viewer.

    Args:
        packed: drawings (`tkamb.show.view.payload.pack`); None: a server sends them.
        frame: frame at which the page opens.
        live: names of the contact models that the server offers; None without a server.
    """
    # The text of a script must not contain its closing tag.
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
    """Return the JavaScript of meshcat's viewer, with three.js."""
    root = Path(meshcat.__file__).parent
    return (root / "viewer" / "dist" / "main.min.js").read_text(encoding="utf-8")


def find_browser() -> str:
    """Return the path of a Chromium-like browser.

    Raises:
        ComputationError: no browser is installed.
    """
    result = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if result is None:
        raise ComputationError(
            "no browser found", hint="install chromium (Debian: apt install chromium)"
        )
    return result


def screenshot(html: str, size: tuple[int, int]) -> bytes:
    """Return a PNG of a self-contained page of `page_html`, without its controls.

    Args:
        size: width and height, pixels.

    Raises:
        ComputationError: no browser is installed, or it does not draw the page.
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
            # The page unpacks its data after it is loaded, and needs virtual time for this.
            "--virtual-time-budget=20000",
            f"--screenshot={picture}",
            "--dump-dom",
            f"{page.as_uri()}#figure=1",
        ]
        try:
            process = subprocess.run(command, capture_output=True, timeout=TIMEOUT)
        except subprocess.TimeoutExpired:
            raise ComputationError(f"no picture of the page in {TIMEOUT:g} s") from None
        if b'data-ready="yes"' not in process.stdout or not picture.exists():
            raise ComputationError("the page could not be drawn", str(browser))
        return picture.read_bytes()
