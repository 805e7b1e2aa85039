"""Setup of all tests: the usual handler of Ctrl-C, and a browser fixture."""

import signal

import pytest

import headless
from shared_surfaces import shared_surfaces

# Without this, tests in the background of a shell and their child processes would ignore SIGINT.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def surfaces():
    """Share surfaces of meshes with the same content."""
    with shared_surfaces() as store:
        yield store


@pytest.fixture
def fresh_surfaces(surfaces):
    """Read all meshes again in a test that counts what is computed once for a mesh."""
    surfaces.clear()


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
