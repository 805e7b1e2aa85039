"""Data flows one way: which module may import which, read from the code itself."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "tkamb"

COMMON = {"atomic", "code_identity", "columns", "command_options", "defaults", "errors", "files"}
COMMON |= {"known_errors", "memory", "units"}
"""Modules of the top level that any folder may use."""
RESULTS = {"results", "results_folder"}
ALLOWED = {
    "geometry": set(),
    "inputs": {"geometry"},
    "opensim": {"geometry"},
    "body": {"geometry"},
    "contact": {"geometry"},
    "scene": {"geometry", "inputs", "body"},
    "equilibrium": {"geometry", "body", "contact", "scene"},
    "importing": {"geometry", "inputs", "opensim", "scene"},
    "plausibility": {"geometry", "inputs", "scene"},
    "run": {"geometry", "body", "contact", "equilibrium", "scene", "output"} | RESULTS,
    "output": {"geometry", "contact", "run"} | RESULTS,
    "view": {"geometry", "body", "contact", "equilibrium", "scene", "run", "output", "simulation"}
    | RESULTS,
    "press": {"geometry", "inputs", "contact", "equilibrium"},
    "studies": {"geometry", "inputs", "contact", "equilibrium", "scene", "run", "output", "press"}
    | {"claim", "simulation"},
    "datasets": set(),
    "starter": set(),
}
"""Folder -> what else of the package it may import; see docs/architecture.md."""
SEES_BODY_AND_CONTACT = {"contact_side.py", "simulation.py"}


def imported(path):
    """Return the tkamb modules that a file imports, those for type checking left out."""
    names, tree = set(), ast.parse(path.read_text(encoding="utf-8"))
    typing = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for statement in node.body
        for inner in ast.walk(statement)
    }
    for node in set(ast.walk(tree)) - typing:
        if isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
    return {name for name in names if name.startswith("tkamb")}


def test_every_folder_has_its_row():
    folders = {path.parent.name for path in PACKAGE.glob("*/*.py")}
    assert folders == set(ALLOWED)


@pytest.mark.parametrize("layer", sorted(ALLOWED))
def test_layers_import_only_downwards(layer):
    for path in (PACKAGE / layer).rglob("*.py"):
        others = {name.split(".")[1] for name in imported(path) if "." in name}
        beyond = others - {layer} - ALLOWED[layer] - COMMON
        assert not beyond, f"{path.name} imports {beyond}"


def test_the_layer_test_can_fail():
    assert "tkamb.body.chain" in imported(PACKAGE / "equilibrium" / "mechanics.py")


def test_only_two_files_see_body_and_contact():
    folders = ("equilibrium", "run", "press", "scene")
    for path in [*PACKAGE.glob("*.py"), *(p for f in folders for p in (PACKAGE / f).glob("*.py"))]:
        names = imported(path)
        sees = {
            layer
            for layer in ("body", "contact")
            for name in names
            if name.startswith(f"tkamb.{layer}.")
        }
        through = {"tkamb.equilibrium.mechanics": "body"}
        sees |= {layer for module, layer in through.items() if module in names}
        if len(sees) == 2:
            assert path.name in SEES_BODY_AND_CONTACT, f"{path.name} sees {sees}"


def module_name(path):
    """Return the dotted name of a file of the package."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def circles(graph):
    """Return the sets of modules that can reach each other: depth first, after Tarjan (1972)."""
    order, low, stack, found = {}, {}, [], []

    def visit(node):
        order[node] = low[node] = len(order)
        stack.append(node)
        for other in graph[node] - {node}:
            if other not in order:
                visit(other)
            if other in stack:
                low[node] = min(low[node], low[other])
        if low[node] == order[node]:
            first = stack.index(node)
            found.append(set(stack[first:]))
            del stack[first:]

    for node in graph:
        if node not in order:
            visit(node)
    return [one for one in found if len(one) > 1]


def test_no_circle_of_imports_late_ones_counted():
    files = {module_name(path): path for path in PACKAGE.rglob("*.py")}
    graph = {name: imported(path) & set(files) for name, path in files.items()}
    assert graph["tkamb.simulation"]
    assert circles(graph) == []


def test_a_circle_is_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [{"a", "b", "c"}]
