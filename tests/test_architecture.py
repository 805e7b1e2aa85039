"""Layers of the package: a folder imports only from lower folders, also by `import_module`."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "tkamb"

ORDER = ("geometry", "contact", "knee", "io", "run", "studies", "show", "commands")
"""Folders from the lowest to the highest. Each imports only from lower ones and itself."""
SERVES_ALL = {"errors", "files", "named_classes", "settings", "units"}
"""Modules that every folder may import."""
ON_TOP = {"__init__", "__main__", "cli", "crocoddyl", "crocoddyl_pair", "testing"}
"""Modules that may import every folder."""


@cache
def imported(path):
    """Return the tkamb modules that a file imports, except for type checking.

    A text "tkamb.module:Name", or a text that is the name of a module in a file that uses
    `import_module`, counts as an import of the module.
    """
    text = path.read_text(encoding="utf-8")
    names, tree, by_name = set(), ast.parse(text), "import_module" in text
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
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            names.update(named_module(node.value, by_name))
    return {name for name in names if name.startswith("tkamb")}


def named_module(text, by_name):
    """Return the module that a text names: {"tkamb.a.b"} for "tkamb.a.b:Name"."""
    match = re.fullmatch(r"(tkamb(?:\.\w+)+)(:\w+)?", text)
    return {match[1]} if match and (match[2] or by_name) else set()


def part_of(name):
    """Return the folder or top-level module of a dotted name; "" for the package itself."""
    parts = name.split(".")
    public = {"__version__", "code_identity"}  # names in the package's __init__
    return parts[1] if len(parts) > 1 and parts[1] not in public else ""


@pytest.mark.parametrize("folder", ORDER)
def test_folders_import_only_lower_folders(folder):
    lower = {*ORDER[: ORDER.index(folder) + 1], *SERVES_ALL, ""}
    for path in (PACKAGE / folder).rglob("*.py"):
        for name in imported(path):
            assert part_of(name) in lower, f"{path.relative_to(PACKAGE)} imports {name}"


def test_modules_that_serve_all_import_no_folder():
    for module in SERVES_ALL:
        for name in imported(PACKAGE / f"{module}.py"):
            assert part_of(name) in SERVES_ALL | {""}, f"{module} imports {name}"


def test_there_are_no_other_folders_and_modules():
    folders = {path.name for path in PACKAGE.iterdir() if any(path.glob("*.py"))}
    assert folders == set(ORDER)
    assert {path.stem for path in PACKAGE.glob("*.py")} == SERVES_ALL | ON_TOP


def test_imported_modules_are_found():
    names = imported(PACKAGE / "run" / "recording.py")
    assert "tkamb.knee.instant" in names
    assert part_of("tkamb.knee.instant") == "knee"
    assert "tkamb.contact.hertz" in imported(PACKAGE / "contact" / "registry.py")


def test_an_import_by_name_is_found(tmp_path):
    (tmp_path / "low.py").write_text('import_module("tkamb.show.plots").plot()')
    assert imported(tmp_path / "low.py") == {"tkamb.show.plots"}
    (tmp_path / "low.py").write_text('PAGES = {"plots": "tkamb.show.plots:plot"}')
    assert imported(tmp_path / "low.py") == {"tkamb.show.plots"}


@pytest.mark.parametrize("folder", ORDER[:-1])
def test_a_computed_name_is_imported_only_by_named_classes(folder):
    """`NamedClasses` gets its names from tables of texts, which `imported` reads."""
    users = {
        path.name
        for path in (PACKAGE / folder).rglob("*.py")
        if re.search(r"import_module\((?!\")", path.read_text(encoding="utf-8"))
    }
    assert not users


@cache
def names_in(module):
    """Return the names at the top of a module, and its submodules; None: no module of tkamb."""
    path = PACKAGE.parent.joinpath(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    if not file.exists():
        return None
    names = {inner.stem for inner in path.iterdir()} if path.is_dir() else set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names.update(alias.asname or alias.name for alias in node.names)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
    return names


def test_scripts_import_names_that_exist():
    """A script that no test runs would break unseen if a name of the package changes."""
    scripts = (path for path in (PACKAGE.parent / "scripts").rglob("*") if path.is_file())
    texts = {path: path.read_bytes() for path in scripts if path.suffix in ("", ".py")}
    python = {path: text for path, text in texts.items() if path.suffix or b"python" in text[:40]}
    assert len(python) > 50
    for path, text in python.items():
        for node in ast.walk(ast.parse(text)):
            module = getattr(node, "module", None) or ""
            if module.startswith("tkamb.") and isinstance(node, ast.ImportFrom):
                names, missing = names_in(module), {alias.name for alias in node.names}
                assert names is not None, f"{path.name} imports {module}"
                assert missing <= names, f"{path.name} imports {missing - names} from {module}"


def test_physics_does_not_import_scenes_or_files():
    for folder in ("geometry", "contact", "knee"):
        for path in (PACKAGE / folder).rglob("*.py"):
            assert not any(part_of(name) in ("io", "run") for name in imported(path)), path


def module_name(path):
    """Return the dotted name of a file of the package."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def cycles(graph):
    """Return the strongly connected components with more than one module (Tarjan 1972)."""
    order, low, stack, components = {}, {}, [], []

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
            components.append(set(stack[first:]))
            del stack[first:]

    for node in graph:
        if node not in order:
            visit(node)
    return [one for one in components if len(one) > 1]


def test_imports_have_no_cycle():
    files = {module_name(path): path for path in PACKAGE.rglob("*.py")}
    graph = {name: imported(path) & set(files) for name, path in files.items()}
    graph["tkamb"] = set()  # offers the names of all folders, each imported at its first use
    assert graph["tkamb.run.simulation"]
    assert cycles(graph) == []


def test_a_cycle_of_imports_is_found():
    assert cycles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [{"a", "b", "c"}]
