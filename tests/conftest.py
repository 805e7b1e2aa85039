"""What every test finds: Ctrl-C as a terminal sends it, and a browser for those that ask."""

import signal

import pytest

import headless

# A shell that starts the tests in the background has them, and what they start, ignore SIGINT.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def chromium():
    """One browser for all pages of the tests."""
    with headless.chromium() as browser:
        yield browser
