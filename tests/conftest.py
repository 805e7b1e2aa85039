"""Setup of all tests: the usual handler of Ctrl-C, and a browser fixture."""

import signal

import pytest

import headless
from shared_surfaces import shared_surfaces

# Without this, tests in the background of a shell and their child processes would ignore SIGINT.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def implants():
    """Read the implants of the shipped knee once."""
    with shared_surfaces():
        yield


@pytest.fixture(scope="module")
def plain_report():
    """Replace the report of a run, which takes as long to draw as fifty frames take to compute."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "tkamb.show.report.report_html", lambda results, progress=None: "<html></html>"
        )
        yield


@pytest.fixture(scope="session")
def chromium():
    """Return one browser for all tests."""
    with headless.chromium() as browser:
        yield browser
