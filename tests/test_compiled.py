"""Compiled loops: their cache, and compilation without one."""

import ast
import subprocess
import sys
from pathlib import Path

import tkamb

NOWHERE = """
from tkamb.geometry.compiled import compiled

@compiled
def doubled(x):
    return 2 * x

@compiled
def tripled(x):
    return 3 * x

print(doubled(2.0) + tripled(1.0))
"""
"""No file holds these functions, so that numba finds no folder for them."""


def test_without_a_cache_folder_functions_are_compiled_with_one_warning():
    process = subprocess.run(
        [sys.executable, "-c", NOWHERE], capture_output=True, text=True, check=True
    )
    assert process.stdout.strip() == "7.0"
    assert process.stderr.count("NUMBA_CACHE_DIR") == 1


def test_compiled_functions_use_nothing_of_other_files():
    """The cache detects changes of a function's own file only."""
    kernels, foreign = 0, []
    for path in Path(tkamb.__file__).parent.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
        of_tkamb = [node for node in imports if (node.module or "").startswith("tkamb")]
        names = {name.asname or name.name for node in of_tkamb for name in node.names}
        for function in (node for node in tree.body if isinstance(node, ast.FunctionDef)):
            marks = {mark.id for mark in function.decorator_list if isinstance(mark, ast.Name)}
            if marks & {"compiled", "compiled_as_written"}:
                kernels += 1
                inside = [node for line in function.body for node in ast.walk(line)]
                used = {node.id for node in inside if isinstance(node, ast.Name)}
                foreign += [(path.name, function.name, name) for name in used & names]
    assert kernels > 20
    assert foreign == []
