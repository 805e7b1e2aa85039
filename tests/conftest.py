"""Setup of all tests: the usual handler of Ctrl-C, and a fixture of a browser."""

import signal

import pytest

import headless

# Tests that a shell starts in the background, and their child processes, would ignore SIGINT.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def chromium():
    """Return one browser for all tests."""
    with headless.chromium() as browser:
        yield browser
