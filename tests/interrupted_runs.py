"""Runs that are broken off, and folders that somebody else writes into."""

import threading
from contextlib import contextmanager

from tkamb.io.claim import claimed_directory


def broken_off(after):
    """Return a `progress` that is interrupted after so many jobs."""

    def progress(jobs, count):
        for index, one in enumerate(jobs):
            if index == after:
                raise KeyboardInterrupt
            yield one

    return progress


@contextmanager
def held_elsewhere(folder):
    """Have another thread write into a folder while the block runs."""
    held, done = threading.Event(), threading.Event()

    def hold():
        with claimed_directory(folder):
            held.set()
            done.wait()

    other = threading.Thread(target=hold)
    other.start()
    held.wait()
    try:
        yield
    finally:
        done.set()
        other.join()
