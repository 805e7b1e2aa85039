"""Faults of one line in Python source: the places to change, and the changed text.

A seed draws from all possible faults; the same seed and source give the same faults.
"""

import ast
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

KINDS = ("sign", "scale", "index", "arguments", "comparison", "term")
SCALE = 1.05
FLIPPED = {
    ast.Lt: ">=", ast.LtE: ">", ast.Gt: "<=", ast.GtE: "<", ast.Eq: "!=", ast.NotEq: "==",
}  # fmt: skip

SYMMETRIC = ("max", "min", "np.maximum", "np.minimum", "math.hypot", "np.hypot")
"""Functions whose arguments may be swapped."""


@dataclass(frozen=True)
class Fault:
    """A fault: in `file`, function `function`, line `line`, columns `begin` to `end`."""

    file: str
    function: str
    kind: str
    line: int
    begin: int
    end: int
    before: str
    after: str
    text: str

    @property
    def change(self) -> str:
        """Return the function and the change, without the line."""
        return f"{self.file}:{self.function}:{self.kind}:{self.before}->{self.after}"

    @property
    def name(self) -> str:
        """Return a name that stays the same as long as the line does."""
        return f"{self.change} in {self.text}"

    def applied(self, text: str) -> str:
        """Return the source with the fault."""
        lines = text.splitlines(keepends=True)
        line = lines[self.line - 1].encode()
        assert line[self.begin : self.end].decode() == self.before
        lines[self.line - 1] = (
            line[: self.begin] + self.after.encode() + line[self.end :]
        ).decode()
        return "".join(lines)


class _Finder(ast.NodeVisitor):
    """Collects the possible faults of a module, except in messages, annotations and defaults."""

    def __init__(self, file: str, text: str) -> None:
        self.file, self.lines, self.faults = file, text.encode().splitlines(), []
        self._inside: list[str] = []
        self._function = False

    def visit_FunctionDef(self, node):
        if self._function:  # an inner function counts as part of the outer one
            return self.generic_visit(node)
        self._function = True
        self.visit_ClassDef(node)
        self._function = False

    def visit_ClassDef(self, node):
        self._inside.append(node.name)
        for statement in node.body:
            self.visit(statement)
        self._inside.pop()

    def visit_Raise(self, node):
        """Skip messages: they hold no physics."""

    visit_JoinedStr = visit_Assert = visit_Raise

    def visit_AnnAssign(self, node):
        if node.value is not None:
            self.visit(node.value)

    def visit_BinOp(self, node):
        left, right = (self._source(side) for side in (node.left, node.right))
        if isinstance(node.op, ast.Add | ast.Sub):
            other = "-" if isinstance(node.op, ast.Add) else "+"
            self._add("sign", node, f"{left} {other} ({right})")
            self._add("term", node, left)
        elif isinstance(node.op, ast.Mult | ast.Div | ast.MatMult):
            self._add("scale", node, f"({self._source(node)}) * {SCALE}")
        self.generic_visit(node)

    def visit_UnaryOp(self, node):
        if isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
            self._add("sign", node, f"(+{self._source(node.operand)})")
        self.generic_visit(node)

    def visit_Subscript(self, node):
        index = node.slice
        if isinstance(index, ast.Constant) and isinstance(index.value, int):
            other = index.value - 1 if index.value > 0 else index.value + 1
            self._add("index", index, str(other))
        self.generic_visit(node)

    def visit_Call(self, node):
        plain = not any(isinstance(a, ast.Starred) for a in node.args)
        if plain and len(node.args) >= 2 and self._source(node.func) not in SYMMETRIC:
            first, second = (self._source(a) for a in node.args[:2])
            if first != second:
                rest = [self._source(a) for a in node.args[2:]]
                keys = [f"{k.arg}={self._source(k.value)}" for k in node.keywords if k.arg]
                if len(keys) == len(node.keywords):
                    given = ", ".join([second, first, *rest, *keys])
                    self._add("arguments", node, f"{self._source(node.func)}({given})")
        self.generic_visit(node)

    def visit_Compare(self, node):
        if len(node.ops) == 1 and type(node.ops[0]) in FLIPPED:
            left, right = self._source(node.left), self._source(node.comparators[0])
            self._add("comparison", node, f"{left} {FLIPPED[type(node.ops[0])]} {right}")
        self.generic_visit(node)

    def _source(self, node):
        """Return the first line of a node's text."""
        end = node.end_col_offset if node.lineno == node.end_lineno else None
        return self.lines[node.lineno - 1][node.col_offset : end].decode()

    def _add(self, kind, node, after):
        if not self._inside or node.lineno != node.end_lineno:
            return
        before = self._source(node)
        spot = (node.lineno, node.col_offset, node.end_col_offset)
        function, text = ".".join(self._inside), self.lines[node.lineno - 1].decode().strip()
        self.faults.append(Fault(self.file, function, kind, *spot, before, after, text))


def all_faults(root: Path, folders: tuple[str, ...]) -> list[Fault]:
    """Return every possible fault of the modules in some folders, in order."""
    found = []
    for folder in folders:
        for path in sorted((root / folder).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            finder = _Finder(path.relative_to(root).as_posix(), text)
            finder.visit(ast.parse(text))
            found += finder.faults
    return found


def drawn(root: Path, faults: list[Fault], count: int, seed: int) -> list[Fault]:
    """Return some faults with valid syntax, at most one per line; the kinds alternate.

    Their order depends only on their own source, so that a change elsewhere changes few of them.
    """
    heaps = {kind: [f for f in faults if f.kind == kind] for kind in KINDS}
    for heap in heaps.values():
        heap.sort(key=lambda fault: sha256(f"{seed} {fault.change}".encode()).hexdigest())
    chosen, lines = [], set()
    while len(chosen) < count and any(heaps.values()):
        for heap in heaps.values():
            while heap:
                fault = heap.pop()
                text = (root / fault.file).read_text(encoding="utf-8")
                if (fault.file, fault.line) not in lines and _compiles(fault, text):
                    lines.add((fault.file, fault.line))
                    chosen.append(fault)
                    break
    return chosen[:count]


def _compiles(fault: Fault, text: str) -> bool:
    try:
        changed = ast.parse(fault.applied(text))
    except SyntaxError:
        return False
    return ast.dump(changed) != ast.dump(ast.parse(text))
