"""Small faults in a module's text: operators, conditions, constants, results and left-out statements.

Not touched are annotations, decorators, docstrings, assertions, the arguments of what is raised or warned of, and texts
with spaces or in f-strings: what they say is for people.
"""

import ast
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

SWAPS: dict[type[ast.AST], str] = {
    ast.Lt: "<=",
    ast.LtE: "<",
    ast.Gt: ">=",
    ast.GtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.Is: "is not",
    ast.IsNot: "is",
    ast.In: "not in",
    ast.NotIn: "in",
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.FloorDiv: "*",
    ast.Mod: "*",
    ast.Pow: "*",
    ast.LShift: ">>",
    ast.RShift: "<<",
    ast.BitAnd: "|",
    ast.BitOr: "&",
    ast.And: "or",
    ast.Or: "and",
}
SIGNS = {
    operator: SWAPS[other]
    for other, operator in [
        (ast.Lt, ast.LtE),
        (ast.LtE, ast.Lt),
        (ast.Gt, ast.GtE),
        (ast.GtE, ast.Gt),
        (ast.Eq, ast.NotEq),
        (ast.NotEq, ast.Eq),
        (ast.Is, ast.IsNot),
        (ast.IsNot, ast.Is),
        (ast.In, ast.NotIn),
        (ast.NotIn, ast.In),
    ]
}
MESSAGE_CALLS = frozenset({"require", "_problem", "_warn", "warn", "isinstance", "issubclass"})

Node: TypeAlias = ast.stmt | ast.expr
Fault: TypeAlias = tuple[ast.stmt, str, bool, Node, str]


@dataclass(frozen=True)
class Mutant:
    """A fault.

    Attributes:
        path: the module, from the root of the repository.
        lines: first and last line of the statement that is changed, and so of what a test has to run.
        where: name of the function or class around it; empty at the top of the module.
        on_import: whether the statement runs when the module is imported.
        what: old text and new text.
        text: the whole module with the fault.
        id: does not change when code moves to another file or line.
    """

    path: str
    lines: tuple[int, int]
    where: str
    on_import: bool
    what: str
    text: str
    id: str


def mutants_of(path: str, text: str) -> list[Mutant]:
    """Return all faults of a module, in the order of its text."""
    encoded, seen = text.encode(), dict[str, int]()
    starts = [0]
    for line in encoded.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = []
    for statement, where, on_import, node, new in _faults(ast.parse(text).body, "", on_import=True):
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        begin, end = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
        old = encoded[begin:end].decode()
        new = new.replace("{}", old)
        mutated = (encoded[:begin] + new.encode() + encoded[end:]).decode()
        what = " ".join(f"{old} → {new}".split())
        name = f"{path.rpartition('/')[2]} {where}: {what}"
        seen[name] = seen.get(name, 0) + 1
        identity = hashlib.sha256(f"{name} {seen[name]}".encode()).hexdigest()[:8]
        found.append(Mutant(path, _lines(statement), where, on_import, what, mutated, identity))
    return found


def _lines(statement: ast.stmt) -> tuple[int, int]:
    body = getattr(statement, "body", None)
    last = body[0].lineno - 1 if body else statement.end_lineno
    return statement.lineno, max(statement.lineno, last or statement.lineno)


def _faults(body: list[ast.stmt], where: str, *, on_import: bool) -> Iterator[Fault]:
    """Yield statement, place, whether it runs on import, node to replace, and the new text: {} stands for the old."""
    for statement in body:
        if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            name = f"{where}.{statement.name}".lstrip(".")
            if not isinstance(statement, ast.ClassDef):
                for default in (*statement.args.defaults, *filter(None, statement.args.kw_defaults)):
                    yield from ((statement, name, True, node, new) for node, new in _in_expression(default))
            yield from _faults(statement.body, name, on_import=on_import and isinstance(statement, ast.ClassDef))
            continue
        if isinstance(statement, ast.Assert | ast.Import | ast.ImportFrom) or _is_for_types(statement):
            continue
        yield from ((statement, where, on_import, node, new) for node, new in _in_statement(statement, where))
        for part in ("body", "orelse", "finalbody"):
            yield from _faults(getattr(statement, part, []), where, on_import=on_import)
        for handler in (*getattr(statement, "handlers", ()), *getattr(statement, "cases", ())):
            yield from _faults(handler.body, where, on_import=on_import)


def _is_for_types(statement: ast.stmt) -> bool:
    if isinstance(statement, ast.AnnAssign):
        return statement.value is None or "TypeAlias" in ast.dump(statement.annotation)
    return isinstance(statement, ast.If) and ast.unparse(statement.test) == "TYPE_CHECKING"


def _in_statement(statement: ast.stmt, where: str) -> Iterator[tuple[Node, str]]:
    is_text = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
    sets_part = isinstance(statement, ast.Assign) and not isinstance(statement.targets[0], ast.Name | ast.Tuple)
    left_out = (ast.Expr, ast.AugAssign, ast.Raise, ast.Break, ast.Continue, ast.Delete)
    if is_text:
        return
    if where and (isinstance(statement, left_out) or sets_part):
        yield statement, "pass"
    if isinstance(statement, ast.Raise):
        return
    if isinstance(statement, ast.Return) and statement.value and ast.unparse(statement.value) not in ("None", "False"):
        yield statement, "return None"
    if isinstance(statement, ast.If | ast.While):
        yield statement.test, "not ({})"
    for name, value in ast.iter_fields(statement):
        if name not in ("body", "orelse", "finalbody", "handlers", "cases", "annotation", "targets", "target"):
            for one in value if isinstance(value, list) else [value]:
                if isinstance(one, ast.expr | ast.withitem):
                    yield from _in_expression(one)


def _in_expression(node: ast.AST) -> Iterator[tuple[Node, str]]:
    match node:
        case ast.JoinedStr() | ast.Call(func=ast.Name(id="TypeVar")):
            return
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)) if name in MESSAGE_CALLS:
            for argument in node.args[:1]:
                yield from _in_expression(argument)
            return
        case ast.Compare():
            for idx, operator in enumerate(node.ops):
                signs = [SIGNS[type(one)] for one in node.ops]
                signs[idx] = SWAPS[type(operator)]
                pairs = zip(signs, map(ast.unparse, node.comparators), strict=True)
                yield node, f"({ast.unparse(node.left)} {' '.join(f'{sign} {right}' for sign, right in pairs)})"
        case ast.BoolOp(op=operator, values=[*values]):
            yield node, f" {SWAPS[type(operator)]} ".join(f"({ast.unparse(value)})" for value in values)
        case ast.BinOp(op=operator) if type(operator) in SWAPS and not _has_text(node):
            yield node, _between(node.left, SWAPS[type(operator)], node.right)
        case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.Invert()):
            yield node, f"({ast.unparse(node.operand)})"
        case ast.IfExp():
            yield node.test, "not ({})"
        case ast.comprehension():
            yield from ((test, "not ({})") for test in node.ifs)
        case ast.keyword(arg="strict"):
            return
        case ast.Constant(value=bool(value)):
            yield node, str(not value)
        case ast.Constant(value=int(value)):
            yield node, str(value + 1)
        case ast.Constant(value=float(value)):
            yield node, repr(value * 2 or 1.0)
        case ast.Constant(value=str(value)) if " " not in value:
            yield node, repr(value + "X")
    for child in ast.iter_child_nodes(node):
        yield from _in_expression(child)


def _between(left: ast.expr, operator: str, right: ast.expr) -> str:
    return f"(({ast.unparse(left)}) {operator} ({ast.unparse(right)}))"


def _has_text(node: ast.BinOp) -> bool:
    """Return whether an operand is a text: paths and strings are joined with / and +, and anything else would raise."""
    return any(isinstance(one, ast.JoinedStr) or isinstance(getattr(one, "value", 0), str) for one in ast.walk(node))
