"""Find the names that a piece of code uses from outside: of its module, or imported inside it."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeAlias

ABSOLUTE = "/"
"""Prefix of references that are absolute paths, `module.name` or `module:name`; others begin with a name of their own
module. The name behind the colon is looked up in the module, and may be a module itself."""

Import: TypeAlias = ast.Import | ast.ImportFrom
BindingsOf: TypeAlias = "Callable[[Import], Mapping[str, str]]"
"""Returns the names that an import binds, each with the path that it refers to."""

_DYNAMIC_IMPORTS = frozenset({"import_module", "find_spec", "__import__"})
_COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)


@dataclass(slots=True)
class References:
    """What a piece of code uses.

    Attributes:
        used: dotted references, see `ABSOLUTE`.
        annotations: references in annotations of functions and variables, which do not affect results.
        imports: the imports inside functions.
    """

    used: set[str] = field(default_factory=set)
    annotations: set[str] = field(default_factory=set)
    imports: list[Import] = field(default_factory=list)


def references_of(statement: ast.stmt, bindings_of: BindingsOf) -> References:
    """Return what a top-level statement uses."""
    finder = _Finder(bindings_of)
    finder.visit(statement)
    return finder.found


class _Finder(ast.NodeVisitor):
    """Collects names that no enclosing function defines; names defined in classes are ignored, which finds too many."""

    def __init__(self, bindings_of: BindingsOf) -> None:
        self.found = References()
        self._bindings_of = bindings_of
        self._scopes: list[dict[str, str]] = []
        self._into = self.found.used
        self._in_class = False

    def visit_Name(self, node: ast.Name) -> None:
        if not (self._in_class and isinstance(node.ctx, ast.Store)):  # the name of a field refers to nothing
            self._refer(node.id)

    def visit_Attribute(self, node: ast.Attribute) -> None:
        chain = dotted(node)
        if chain:
            self._refer(chain)
        else:
            self.visit(node.value)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        self._function(node)

    def visit_AsyncFunctionDef(self, node: ast.AsyncFunctionDef) -> None:
        self._function(node)

    def visit_Lambda(self, node: ast.Lambda) -> None:
        self._defaults(node.args)
        with self._scope(_own_names(node, self._bindings_of)):
            self.visit(node.body)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for part in (*node.decorator_list, *node.bases, *node.keywords):
            self.visit(part)
        was, self._in_class = self._in_class, True
        for statement in node.body:
            self.visit(statement)
        self._in_class = was

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if self._in_class:
            self._annotation(node.annotation)
        else:
            with self._annotations():
                self._annotation(node.annotation)
        self.visit(node.target)
        if node.value is not None:
            self.visit(node.value)

    def visit_Import(self, node: ast.Import) -> None:
        self.found.imports.append(node)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        self.found.imports.append(node)
        if any(alias.name == "*" for alias in node.names):
            self._into.update(ABSOLUTE + path for path in self._bindings_of(node).values())

    def visit_Call(self, node: ast.Call) -> None:
        named = dotted(node.func).rpartition(".")[2] in _DYNAMIC_IMPORTS and node.args
        if named and isinstance(node.args[0], ast.Constant) and isinstance(node.args[0].value, str):
            self._into.add(ABSOLUTE + node.args[0].value)
        self.generic_visit(node)

    def generic_visit(self, node: ast.AST) -> None:
        if isinstance(node, _COMPREHENSIONS):
            self.visit(node.generators[0].iter)  # it is evaluated in the outer scope
            with self._scope(dict.fromkeys(_stored(node), "")):
                super().generic_visit(node)
        else:
            super().generic_visit(node)

    def _function(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        for decorator in node.decorator_list:
            self.visit(decorator)
        self._defaults(node.args)
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs, node.args.vararg, node.args.kwarg]
        with self._annotations():
            for annotation in (*(one.annotation for one in arguments if one is not None), node.returns):
                if annotation is not None:
                    self._annotation(annotation)
        was, self._in_class = self._in_class, False
        with self._scope(_own_names(node, self._bindings_of)):
            for statement in node.body:
                self.visit(statement)
        self._in_class = was

    def _defaults(self, arguments: ast.arguments) -> None:
        for default in (*arguments.defaults, *arguments.kw_defaults):
            if default is not None:
                self.visit(default)

    def _annotation(self, node: ast.expr) -> None:
        """Visit an annotation, including names in strings."""
        self.visit(node)
        for inner in ast.walk(node):
            if isinstance(inner, ast.Constant) and isinstance(inner.value, str):
                try:
                    self.visit(ast.parse(inner.value, mode="eval").body)
                except SyntaxError:
                    continue  # not an expression, as in Annotated[int, "of the grid"]

    def _refer(self, chain: str) -> None:
        root, _, rest = chain.partition(".")
        for scope in reversed(self._scopes):
            if root in scope:
                if path := scope[root]:
                    self._into.add(f"{ABSOLUTE}{path}.{rest}" if rest else ABSOLUTE + path)
                return
        self._into.add(chain)

    @contextmanager
    def _scope(self, names: dict[str, str]) -> Iterator[None]:
        self._scopes.append(names)
        yield
        self._scopes.pop()

    @contextmanager
    def _annotations(self) -> Iterator[None]:
        was, self._into = self._into, self.found.annotations
        yield
        self._into = was


def dotted(node: ast.expr) -> str:
    """Return `a.b.c` for an expression of this form, otherwise an empty string."""
    names: list[str] = []
    while isinstance(node, ast.Attribute):
        names.append(node.attr)
        node = node.value
    return ".".join([node.id, *reversed(names)]) if isinstance(node, ast.Name) else ""


def _own_names(function: Any, bindings_of: BindingsOf) -> dict[str, str]:
    """Return the local names of a function: to the path if it is only imported there, otherwise to ""."""
    arguments = function.args
    given = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, arguments.vararg, arguments.kwarg]
    body = function.body if isinstance(function.body, list) else [function.body]
    stored = {one.arg for one in given if one is not None}
    imported: dict[str, str] = {}
    outer: set[str] = set()
    for node in _inside(body):
        match node:
            case ast.Import() | ast.ImportFrom():
                imported |= bindings_of(node)
            case ast.Global(names=names) | ast.Nonlocal(names=names):
                outer.update(names)
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                stored.add(name)
            case ast.ExceptHandler(name=str(name)) | ast.MatchAs(name=str(name)) | ast.MatchStar(name=str(name)):
                stored.add(name)
            case ast.MatchMapping(rest=str(name)):
                stored.add(name)
            case ast.Name(id=name, ctx=ast.Store() | ast.Del()):
                stored.add(name)
    return {name: imported.get(name, "") for name in (stored | imported.keys()) - outer}


def _inside(nodes: list[Any]) -> Iterator[ast.AST]:
    """Yield the nodes in the scope of a function, without those in inner functions, classes and comprehensions."""
    for node in nodes:
        yield node
        if isinstance(node, (*_FUNCTIONS, ast.ClassDef)):
            continue
        if isinstance(node, _COMPREHENSIONS):
            yield from (inner.target for inner in ast.walk(node) if isinstance(inner, ast.NamedExpr))
            continue
        yield from _inside(list(ast.iter_child_nodes(node)))


def _stored(comprehension: Any) -> set[str]:
    return {
        node.id
        for generator in comprehension.generators
        for node in ast.walk(generator.target)
        if isinstance(node, ast.Name)
    }
