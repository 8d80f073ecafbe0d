"""Digest of a user's plugin file: what the code does counts, comments and layout do not."""

from __future__ import annotations

import ast
from pathlib import Path

from pano_mvs.core.digest import digest_from_value


def code_digest(path: Path) -> str:
    """Return the digest of a Python file's syntax tree and of those of the local files that it imports.

    Raises:
        OSError: if the file cannot be read.
        SyntaxError: if it is not Python.
    """
    trees: dict[str, str] = {}
    _collect(path.resolve(), path.resolve().parent, trees)
    return digest_from_value(trees)


def _collect(path: Path, root: Path, trees: dict[str, str]) -> None:
    name = path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)
    if name in trees:
        return
    tree = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
    trees[name] = ast.dump(_without_docstrings(tree), include_attributes=False)
    for imported in _imported_files(tree, path.parent, root):
        _collect(imported, root, trees)


def _imported_files(tree: ast.Module, folder: Path, root: Path) -> list[Path]:
    """Return the local files that a syntax tree imports, wherever in it: absolute names are looked up from the root."""
    files: list[Path] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                files.extend(_module_files(root, alias.name))
        elif isinstance(node, ast.ImportFrom):
            base = folder.joinpath(*[".."] * (node.level - 1)).resolve() if node.level else root
            module = node.module or ""
            files.extend(_module_files(base, module))
            for alias in node.names:
                files.extend(_module_files(base, f"{module}.{alias.name}" if module else alias.name))
    return files


def _module_files(base: Path, dotted: str) -> list[Path]:
    """Return the files that importing a dotted name runs: its own, and the __init__.py of every package above it."""
    parts = [part for part in dotted.split(".") if part]
    candidates = [base.joinpath(*parts[: depth + 1], "__init__.py") for depth in range(len(parts))]
    if parts:
        candidates.append(base.joinpath(*parts).with_suffix(".py"))
    return [candidate for candidate in candidates if candidate.is_file()]


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            first = node.body[0] if node.body else None
            is_doc = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
            if is_doc and isinstance(first.value.value, str):  # type: ignore[union-attr]
                node.body = node.body[1:] or [ast.Pass()]
    return tree
