"""Compiled loops where nothing can be written."""

import subprocess
import sys

NOWHERE = """
from tkamb.contact.lattice.compiled import compiled

@compiled
def doubled(x):
    return 2 * x

@compiled
def tripled(x):
    return 3 * x

print(doubled(2.0) + tripled(1.0))
"""
"""No file holds these functions, so that numba finds no folder for them."""


def test_without_a_folder_to_keep_them_in_they_are_compiled_and_it_is_said_once():
    done = subprocess.run(
        [sys.executable, "-c", NOWHERE], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "7.0"
    assert done.stderr.count("NUMBA_CACHE_DIR") == 1
