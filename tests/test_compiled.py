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


CALLER = """
from callee import number
from tkamb.geometry.compiled import compiled_as_written

@compiled_as_written
def doubled():
    return 2 * number()

print(doubled())
"""
CALLEE = """
from tkamb.geometry.compiled import compiled_as_written

@compiled_as_written
def number():
    return {}
"""


def test_a_change_of_a_called_function_in_another_file_is_noticed(tmp_path):
    """The caller's stored code contains the code of the called function."""
    (tmp_path / "caller.py").write_text(CALLER, encoding="utf-8")
    for value, stored in ((3, 1), (3, 1), (5, 2)):
        (tmp_path / "callee.py").write_text(CALLEE.format(value), encoding="utf-8")
        command = [sys.executable, str(tmp_path / "caller.py")]
        process = subprocess.run(command, capture_output=True, text=True, check=True)
        assert process.stdout.strip() == str(2 * value)
        assert len(list((tmp_path / "__pycache__").glob("caller.doubled*.nbi"))) == stored


def test_compiled_functions_use_only_compiled_functions_of_other_files():
    """The cache detects changes of a function's own file, and of compiled functions it calls."""
    package, kernels, imported = Path(tkamb.__file__).parent, {}, {}
    for path in package.rglob("*.py"):
        module = ".".join(path.relative_to(package.parent).with_suffix("").parts)
        tree = ast.parse(path.read_text(encoding="utf-8"))
        imported[module] = {
            name.asname or name.name: (node.module, name.name)
            for node in tree.body
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tkamb")
            for name in node.names
        }
        for function in (node for node in tree.body if isinstance(node, ast.FunctionDef)):
            marks = {mark.id for mark in function.decorator_list if isinstance(mark, ast.Name)}
            if marks & {"compiled", "compiled_as_written", "compiled_for_microseconds"}:
                inside = [node for line in function.body for node in ast.walk(line)]
                used = {node.id for node in inside if isinstance(node, ast.Name)}
                kernels[module, function.name] = used
    foreign = {
        (module, function, name)
        for (module, function), used in kernels.items()
        for name in used & imported[module].keys()
        if imported[module][name] not in kernels
    }
    assert len(kernels) > 20
    assert foreign == set()
