"""Compiled loops: what is kept of them, and where nothing can be."""

import ast
import subprocess
import sys
from pathlib import Path

import tkamb

NOWHERE = """
from tkamb.compiled import compiled

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


def test_no_compiled_function_calls_one_of_another_file():
    """Kept code is renewed when its own file changes, not when one that it calls does."""
    kernels, calls = {}, []
    for path in Path(tkamb.__file__).parent.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for function in (node for node in tree.body if isinstance(node, ast.FunctionDef)):
            marks = {mark.id for mark in function.decorator_list if isinstance(mark, ast.Name)}
            if marks & {"compiled", "compiled_as_written"}:
                kernels.setdefault(function.name, set()).add(path)
                names = {node.id for node in ast.walk(function) if isinstance(node, ast.Name)}
                calls += [(path, name) for name in names]
    assert len(kernels) > 20
    assert [
        (path.name, name) for path, name in calls if path not in kernels.get(name, {path})
    ] == []
