"""A pytest plugin that records the time of each test and the functions of the package it calls.

    python -m pytest -p called_functions --called out/called.jsonl tests/test_x.py

It writes one line of JSON per test: its name, seconds, and the functions as "file:Class.function".
"""

import json
import sys
import threading
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = str(ROOT / "tkamb")


def pytest_addoption(parser):
    parser.addoption("--called", type=Path, help="file for the lines")


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item):
    path = item.config.getoption("--called")
    codes = set()

    def trace(frame, event, argument):
        codes.add(frame.f_code)

    start = time.process_time()
    threading.settrace(trace)
    sys.settrace(trace)
    yield
    sys.settrace(None)
    threading.settrace(None)
    names = sorted(
        f"{Path(code.co_filename).relative_to(ROOT).as_posix()}:{function_of(code)}"
        for code in codes
        if code.co_filename.startswith(PACKAGE)
    )
    row = {"test": item.nodeid, "seconds": time.process_time() - start, "called": names}
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


def function_of(code):
    """Return "Class.function" of a code object; for a lambda or loop, its enclosing function."""
    return code.co_qualname.split(".<locals>")[0].split(".<lambda>")[0]
