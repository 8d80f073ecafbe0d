"""Write the part of a syntax tree that can affect results as text, which is the same in all versions of Python."""

from __future__ import annotations

import ast
from typing import Any

_HELP_ARGUMENTS = frozenset({"description", "title", "examples", "doc"})
_IGNORED_FIELDS = frozenset({"ctx", "kind", "type_comment", "type_ignores"})


def strip(tree: ast.AST) -> None:
    """Remove from a tree, in place, what cannot affect results.

    This removes docstrings and other bare strings, `pass`, the annotations of functions and of variables outside
    classes, and the help texts of settings (`Field(description=…)`, `setting(doc=…)`). The annotations in classes are
    kept, because they define the fields of dataclasses and settings.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            node.returns = None
        elif isinstance(node, ast.arg):
            node.annotation = None
        elif isinstance(node, ast.Call) and _name_of(node.func) in {"Field", "setting"}:
            node.keywords = [keyword for keyword in node.keywords if keyword.arg not in _HELP_ARGUMENTS]
        for block in ("body", "orelse", "finalbody"):
            statements = getattr(node, block, None)
            if isinstance(statements, list):
                in_class = isinstance(node, ast.ClassDef)
                kept = (inner if in_class else _without_annotation(inner) for inner in statements)
                setattr(node, block, [inner for inner in kept if inner is not None and not _has_no_effect(inner)])


def _without_annotation(statement: Any) -> Any:
    if not isinstance(statement, ast.AnnAssign):
        return statement
    if statement.value is None:
        return None
    return ast.Assign(targets=[statement.target], value=statement.value)


def _has_no_effect(statement: ast.AST) -> bool:
    bare = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(statement, ast.Pass) or (isinstance(bare, ast.Constant) and isinstance(bare.value, str))


def _name_of(function: ast.expr) -> str:
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


def canonical_text(tree: ast.AST) -> str:
    """Return a tree as text; equal trees give equal texts.

    The text of `ast.dump` depends on the version of Python. This function leaves out empty fields, so that fields added
    by later versions make no difference.
    """
    chunks: list[str] = []
    _write(tree, chunks)
    return "".join(chunks)


def _write(value: Any, chunks: list[str]) -> None:
    if isinstance(value, ast.Constant):
        chunks.append(f"{type(value.value).__name__} {value.value!r};")
    elif isinstance(value, ast.AST):
        chunks.append(f"({type(value).__name__}")
        for name in value._fields:
            inner = getattr(value, name, None)
            if inner is None or inner == [] or name in _IGNORED_FIELDS:
                continue
            if name == "values" and isinstance(value, ast.JoinedStr):
                inner = _merged(inner)
            chunks.append(f" {name}=")
            _write(inner, chunks)
        chunks.append(")")
    elif isinstance(value, list):
        chunks.append("[")
        for item in value:
            _write(item, chunks)
            chunks.append(",")
        chunks.append("]")
    else:
        chunks.append(repr(value))


def _merged(values: list[ast.expr]) -> list[ast.expr]:
    """Return the pieces of an f-string with adjacent texts joined; versions of Python split them differently."""
    merged: list[ast.expr] = []
    for one in values:
        last = merged[-1] if merged else None
        if isinstance(one, ast.Constant) and isinstance(last, ast.Constant):
            merged[-1] = ast.Constant(str(last.value) + str(one.value))
        elif not isinstance(one, ast.Constant) or one.value:
            merged.append(one)
    return merged
