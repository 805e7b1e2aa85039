"""Data flows one way: which module may import which, read from the code itself."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "tkamb"

KNOWN_TO_ALL = {
    *("atomic", "claim", "code_identity", "compiled", "defaults", "errors", "files", "guard"),
    *("activities", "known_errors", "memory", "named_classes", "occupants", "scene_options"),
    *("threads", "units"),
}
"""Modules without knees: numbers, files, memory, messages."""
KNEE = {"body", "contact", "equilibrium", "geometry", "scene"}
SHOWN = {"columns", "output", "results", "results_folder"}
DRAWING = {
    "datasets": set(),
    "starter": {"geometry", "inputs"},
    "geometry": set(),
    "opensim": {"geometry", "inputs"},
    "body": {"geometry"},
    "contact": {"geometry"},
    "inputs": {"geometry"},
    "presets": set(),
    "scene": {"body", "geometry", "inputs", "presets"},
    "equilibrium": {"body", "contact", "geometry", "muscles", "scene"},
    "knee": {"body", "contact", "equilibrium", "geometry"},
    "plausibility": {"geometry", "inputs", "scene"},
    "check": {*KNEE, "output", "plausibility", "run"},
    "compare": {*SHOWN, "geometry", "plug_ins"},
    "decks": {"contact", "geometry", "output", "results", "results_folder", "run"},
    "importing": {"geometry", "inputs", "opensim", "scene"},
    "run": {*KNEE, *SHOWN, "knee", "plausibility", "plug_ins"} - {"results"},
    "output": {"columns", "contact", "geometry", "run"},
    "view": {*KNEE, *SHOWN, "inputs", "run", "simulation"} - {"columns"},
    "studies": {*KNEE, "plug_ins", "decks", "inputs", "output", "run", "simulation"} - {"body"},
    "muscles": {"geometry", "importing", "inputs", "opensim"},
    "designs": {"contact", "geometry"},
    "wear": {"contact", "equilibrium", "geometry", "inputs", "output", "results_folder", "run"}
    | {"plug_ins", "results", "scene", "simulation", "uncertainty"},
    "uncertainty": {*KNEE, "columns", "inputs", "results", "results_folder", "run", "simulation"},
    "cohort": {
        "columns",
        "geometry",
        "output",
        "plug_ins",
        "results",
        "run",
        "scene",
        "simulation",
        "wear",
    },
    "validation": {"body", "contact", "designs", "geometry", "press", "scene", "simulation"}
    | {"studies"},
}
"""Which folder knows which folders and which modules beside them: inputs → body → (equilibrium ⇄
contact) → results → output, view and studies; the scene is where files become bodies."""
SEES_BODY_AND_CONTACT = {"contact_side.py", "read_scene.py"}


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


def part_of(name):
    """Return the folder, or the module beside the folders, that a dotted name belongs to."""
    parts = name.split(".")
    return parts[1] if len(parts) > 1 and parts[1] != "__version__" else ""


@pytest.mark.parametrize("folder", sorted(DRAWING))
def test_a_folder_knows_only_what_the_drawing_says(folder):
    for path in (PACKAGE / folder).rglob("*.py"):
        for name in imported(path):
            allowed = DRAWING[folder] | KNOWN_TO_ALL | {folder, ""}
            assert part_of(name) in allowed, f"{path.name} imports {name}"


def test_every_folder_is_in_the_drawing():
    folders = {path.name for path in PACKAGE.iterdir() if any(path.glob("*.py"))}
    assert folders <= set(DRAWING)


def test_body_and_contact_know_geometry_alone():
    assert DRAWING["body"] == DRAWING["contact"] == {"geometry"}


def test_the_layer_test_can_fail():
    assert "tkamb.body.chain" in imported(PACKAGE / "equilibrium" / "mechanics.py")
    assert part_of("tkamb.body.chain") == "body"


def test_only_two_files_see_body_and_contact():
    folders = ("equilibrium", "run", "scene")
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
