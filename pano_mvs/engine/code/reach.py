"""Follow code by name, from a function to everything that it may use in the modules of some packages.

Nodes are the definitions at the top level of a module: functions, classes and variables. A definition uses what its
names refer to in its module, also where a function has a local variable of the same name, which finds too much rather
than too little. Names computed at run time (`getattr` on a module, imports by a computed name) are not followed; a
module that is used as a value, or imported by a star, counts as a whole. What a module executes when it is imported
counts wherever the module is loaded.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.paths import is_file

_IMPORT, _WHOLE = "<import>", "<all>"
_AT_RUN_TIME = "/"  # prefix of the paths that `import_module` and its like import
_DYNAMIC_IMPORTS = frozenset({"import_module", "find_spec", "__import__"})
_STAGE_DECORATORS = frozenset(
    f"pano_mvs.{module}.{name}" for module in ("api", "engine.stages.stage") for name in ("stage", "source")
)
"""These do not count: their arguments are already in the key of the stage, or cannot affect its result."""

_PURE_DECORATORS = frozenset({"kernel", "inlined", "params_from", "checks_settings"})
"""Decorators of followed packages that register nothing, unlike others."""


@dataclass(frozen=True, slots=True)
class Reach:
    """The code that a function reaches."""

    digest: str
    definitions: dict[str, str]  # `module:name` of each definition, to its digest
    libraries: frozenset[str]  # top-level names of other packages that these use, except the standard library


@dataclass(slots=True)
class _Definition:
    """A top-level name, or all that a module executes on import: its statements, and the names that these use."""

    text: str = ""  # the statements, without what cannot affect results
    uses: set[str] = field(default_factory=set)  # dotted names
    annotations: set[str] = field(default_factory=set)  # dotted names in the annotations of functions
    # names that imports inside of it bind, each to everything that it stands for; see `_Module.bindings`
    bindings: dict[str, set[tuple[str, str]]] = field(default_factory=dict)
    loads: set[str] = field(default_factory=set)  # dotted paths that it imports when it runs


@dataclass(slots=True)
class _Module:
    """What a module holds."""

    package: str  # from which relative imports start
    # those that define each name; `_IMPORT` has what is executed on import beside definitions
    statements: dict[str, list[ast.stmt]] = field(default_factory=dict)
    effect_names: set[str] = field(default_factory=set)  # names that these define
    # imported name to (module, name in it); the name is empty for a module
    bindings: dict[str, tuple[str, str]] = field(default_factory=dict)
    loads: list[str] = field(default_factory=list)  # dotted paths that importing it imports
    stars: list[str] = field(default_factory=list)  # modules from which all names are imported
    _definitions: dict[int, _Definition] = field(default_factory=dict)

    def definition(self, name: str) -> _Definition:
        whole = _Definition()
        for statement in self.statements.get(name, ()):
            if id(statement) not in self._definitions:
                self._definitions[id(statement)] = _definition(statement, self)
            part = self._definitions[id(statement)]
            whole.text += part.text
            whole.uses |= part.uses
            whole.annotations |= part.annotations
            whole.loads |= part.loads
            for own, places in part.bindings.items():
                whole.bindings.setdefault(own, set()).update(places)
        return whole


class CodeGraph:
    """The graph of definitions and the definitions that they use, built on demand."""

    def __init__(
        self,
        packages: Mapping[str, Path],
        *,
        texts: Mapping[str, tuple[str, bool]] | None = None,
        left_out: Iterable[str] = (),
        kept: Iterable[str] = (),
    ) -> None:
        """Create an empty graph.

        Args:
            packages: the packages and modules that are followed, with their folders or files; all others are libraries.
            texts: further modules by dotted name, or other texts of these: source, and whether it is a package.
            left_out: dotted names of packages and modules that are ignored.
            kept: modules inside these that count nevertheless.
        """
        self._packages = dict(packages)
        self._texts = texts or {}
        self._tops = {*packages, *(name.partition(".")[0] for name in self._texts)}
        self._is_out = dict.fromkeys(left_out, True) | dict.fromkeys(kept, False)
        self._modules: dict[str, _Module | None] = {}
        self._nodes: dict[str, tuple[str, set[str], set[str]]] = {}

    def reach_of(self, paths: Iterable[str]) -> Reach:
        """Return some definitions or modules, with the types in their annotations, and everything that they use.

        Args:
            paths: `package.module:name`, or `package.module:` for a whole module.
        """
        libraries: set[str] = set()
        pending: set[str] = set()
        for path in paths:
            module, _, name = path.partition(":")
            pending |= self._targets(module, [name] if name else [], libraries)
            if (found := self._module(module)) is not None:
                for own in [name] if name else found.statements:
                    one = found.definition(own)
                    pending.update(*(self._refer(module, one, use, libraries=libraries) for use in one.annotations))
        reached: dict[str, str] = {}
        while pending:
            name = pending.pop()
            if name not in reached:
                if name not in self._nodes:
                    self._nodes[name] = self._node(*name.split(":"))
                reached[name], targets, used = self._nodes[name]
                libraries |= used
                pending |= targets - reached.keys()
        reached = {name: reached[name] for name in sorted(reached) if reached[name]}
        return Reach(digest_from_value(reached), reached, frozenset(libraries))

    def _node(self, module: str, what: str) -> tuple[str, set[str], set[str]]:
        """Return the digest of a node, the nodes that it uses, and the libraries."""
        found = self._module(module)
        assert found is not None, module
        if what == _WHOLE:
            return "", {f"{module}:{name}" for name in (_IMPORT, *found.statements)}, set()
        libraries: set[str] = set()
        definition = found.definition(what)
        uses = {use: self._refer(module, definition, use, libraries=libraries) for use in sorted(definition.uses)}
        targets = {f"{module}:{_IMPORT}"}.union(*uses.values())
        targets = targets.union(*map(self._imports, definition.loads))
        if what == _IMPORT:
            libraries.clear()  # what a module only loads does not depend on the version of a library
            targets.update(*map(self._imports, (module, *found.loads)))
            for star in found.stars:
                targets |= self._targets(star, [], libraries)
        # Include what names refer to: another import of the same name changes what is called.
        edges = {use: sorted(found_by) or self._paths(module, definition, use) for use, found_by in uses.items()}
        return digest_from_value([definition.text, edges]) if definition.text else "", targets, libraries

    def _refer(self, module: str, definition: _Definition, use: str, *, libraries: set[str]) -> set[str]:
        """Return the nodes to which a dotted name in a definition refers; none for builtins and unknown names."""
        if use.startswith(_AT_RUN_TIME):
            return self._targets(use[1:], [], libraries)
        found = self._module(module)
        assert found is not None, module
        name, *further = use.split(".")
        targets: set[str] = set()
        for home, inner in definition.bindings.get(name, ()):
            targets |= self._targets(home, [*filter(None, [inner]), *further], libraries)
        if name in found.statements or name in found.effect_names or name in found.bindings:
            targets |= self._targets(module, [name, *further], libraries)
        return targets

    def _paths(self, module: str, definition: _Definition, use: str) -> list[str]:
        """Return the paths of a name that leads out of the packages."""
        found = self._module(module)
        assert found is not None, module
        name, dot, rest = use.partition(".")
        own = [found.bindings[name]] if name in found.bindings else []
        return sorted(f"{home}.{inner}{dot}{rest}" for home, inner in {*definition.bindings.get(name, ()), *own})

    def _targets(self, module: str, names: list[str], libraries: set[str]) -> set[str]:
        """Return the nodes of a name in a module; if it leads out of the packages, add the library instead."""
        seen = set()
        top = module.partition(".")[0]
        while top in self._tops:
            found = self._module(module)
            if found is None:
                libraries.add(top)  # such as compiled modules
                return set()
            if self._is_left_out(module):
                return set()
            if not names:
                return {f"{module}:{_WHOLE}"}
            name, *further = names
            bound = found.bindings.get(name)
            if name in found.statements:
                return {f"{module}:{name}"}
            if bound is not None and bound != (module, name) and (module, name) not in seen:
                seen.add((module, name))
                module, names = bound[0], [*filter(None, [bound[1]]), *further]
                top = module.partition(".")[0]
            elif name in found.effect_names:
                return {f"{module}:{_IMPORT}"}
            elif self._module(f"{module}.{name}") is None:
                return {f"{module}:{_WHOLE}"}  # it may come by a star, or at run time
            else:
                module, names = f"{module}.{name}", further
        if top and top not in sys.stdlib_module_names:
            libraries.add(top)
        return set()

    def _imports(self, path: str) -> set[str]:
        """Return the import nodes of the modules on a dotted path."""
        parts = path.split(".")
        above = [".".join(parts[: depth + 1]) for depth in range(len(parts))] if parts[0] in self._tops else []
        return {f"{one}:{_IMPORT}" for one in above if self._module(one) is not None and not self._is_left_out(one)}

    def _is_left_out(self, module: str) -> bool:
        if module not in self._is_out:
            above, _, _ = module.rpartition(".")
            self._is_out[module] = bool(above) and self._is_left_out(above)
        return self._is_out[module]

    def _module(self, module: str) -> _Module | None:
        """Return what a module holds, or None if it does not exist or cannot be read."""
        if module not in self._modules:
            text, is_package = self._texts.get(module) or self._read(module)
            package = module if is_package else module.rpartition(".")[0]
            try:
                self._modules[module] = None if text is None else _analysed(text, package, frozenset(self._tops))
            except (SyntaxError, ValueError):
                self._modules[module] = None
        return self._modules[module]

    def _read(self, module: str) -> tuple[bytes | None, bool]:
        top, *below = module.split(".")
        root = self._packages.get(top)
        if root is None:
            return None, False
        folder = root.joinpath(*below)
        file = folder.with_name(f"{folder.name}.py")
        places = [folder / "__init__.py", *([file] if below else [])] if root.suffix != ".py" else [root][len(below) :]
        path = next(filter(is_file, places), None)
        try:
            return (None if path is None else path.read_bytes()), path == folder / "__init__.py"
        except OSError:
            return None, False


@cache
def _analysed(text: str | bytes, package: str, followed: frozenset[str]) -> _Module:
    """Return what a module holds.

    Args:
        followed: the packages that are followed, whose decorators may register something.

    Raises:
        SyntaxError: if the text is not Python.
        ValueError: if it contains a null character.
    """
    module = _Module(package)
    for statement in ast.parse(text).body:
        names, is_effect = _sorted(statement, module, followed)
        for name in [*names, *([_IMPORT] if is_effect else [])]:
            module.statements.setdefault(name, []).append(statement)
    return module


def _definition(statement: ast.stmt, module: _Module) -> _Definition:
    """Return what a top-level statement means; it is stripped."""
    found = _Definition()
    if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef):
        statement.decorator_list = [
            one for one in statement.decorator_list if ".".join(_decorator(one, module)) not in _STAGE_DECORATORS
        ]
    for node in ast.walk(statement):
        if isinstance(node, ast.Import | ast.ImportFrom):
            found.loads.update(_loaded(node, module.package))
            for name, place in _bound(node, module.package):
                found.bindings.setdefault(name, set()).add(place)
        elif isinstance(node, ast.arg | ast.FunctionDef | ast.AsyncFunctionDef):
            annotation = node.annotation if isinstance(node, ast.arg) else node.returns
            found.annotations.update(() if annotation is None else _names_of_annotation(annotation))
    whole = ast.Module([statement], [])
    strip(whole)
    found.text = canonical_text(whole) if whole.body else ""
    found.uses.update(_names_in(whole))
    return found


def _sorted(statement: ast.stmt, module: _Module, followed: frozenset[str]) -> tuple[list[str], bool]:
    """Return the names that a top-level statement defines, and whether it does more; enter imports into the module."""
    match statement:
        case ast.Import() | ast.ImportFrom():
            _bind(statement, module)
            return [], False
        case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
            made = [_decorator(one, module) for one in statement.decorator_list]
            registers = [
                one
                for one in made
                if ".".join(one) not in _STAGE_DECORATORS
                and one[0].partition(".")[0] in {"", *followed}
                and one[1].rpartition(".")[2] not in _PURE_DECORATORS
            ]
            known = {"", *module.statements, *module.effect_names}  # other names are builtins
            return [statement.name], any(home or name.partition(".")[0] in known for home, name in registers)
        case ast.Assign() | ast.AnnAssign() | ast.AugAssign() if names := _assigned_names(statement):
            return names, False
        case ast.If(test=ast.Name(id="TYPE_CHECKING") | ast.Attribute(attr="TYPE_CHECKING")):
            for inner in ast.walk(statement):
                if isinstance(inner, ast.Import | ast.ImportFrom):
                    module.bindings |= dict(_bound(inner, module.package))
            return [], False
        case ast.Pass() | ast.Expr(value=ast.Constant()):
            return [], False
    for inner in ast.walk(statement):
        if isinstance(inner, ast.Import | ast.ImportFrom):
            _bind(inner, module)
        elif isinstance(inner, ast.Name) and isinstance(inner.ctx, ast.Store):
            module.effect_names.add(inner.id)
        elif isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            module.effect_names.add(inner.name)
    return [], True


def _bind(statement: ast.Import | ast.ImportFrom, module: _Module) -> None:
    for name, (home, inner) in _bound(statement, module.package):
        if inner == "*":
            module.stars.append(home)
        else:
            module.bindings[name] = home, inner
    module.loads.extend(_loaded(statement, module.package))


def _loaded(statement: ast.Import | ast.ImportFrom, package: str) -> Iterator[str]:
    """Yield the dotted paths that an import imports; the last part may be a name in a module."""
    if isinstance(statement, ast.Import):
        yield from (alias.name for alias in statement.names)
    else:
        yield from (f"{home}.{inner}".removesuffix(".*") for _, (home, inner) in _bound(statement, package))


def _bound(statement: ast.Import | ast.ImportFrom, package: str) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield the names that an import binds, each with the module, and the name in it."""
    for alias in statement.names:
        if isinstance(statement, ast.ImportFrom):
            base = statement.module or ""
            if statement.level:
                parts = package.split(".")
                base = ".".join([*parts[: len(parts) - statement.level + 1], *filter(None, [base])])
            yield alias.asname or alias.name, (base, alias.name)
        else:
            top = alias.name.partition(".")[0]
            yield (alias.asname or top), (alias.name if alias.asname else top, "")


def _decorator(decorator: ast.expr, module: _Module) -> tuple[str, str]:
    """Return the module and the name of a decorator, resolved with the imports of the module."""
    chain = _dotted(decorator.func if isinstance(decorator, ast.Call) else decorator)
    root, _, rest = chain.partition(".")
    home, name = module.bindings.get(root, ("", root))
    return home, ".".join(filter(None, [name, rest]))


def _assigned_names(statement: ast.Assign | ast.AnnAssign | ast.AugAssign) -> list[str]:
    """Return the names that an assignment defines; none if it also sets an attribute or an element."""
    targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
    inner = [node for target in targets for node in ast.walk(target)]
    if any(isinstance(node, ast.Attribute | ast.Subscript) for node in inner):
        return []
    return [node.id for node in inner if isinstance(node, ast.Name)]


def _names_in(node: ast.AST) -> Iterator[str]:
    """Yield the dotted names in code, and `_AT_RUN_TIME` with a path for an import at run time."""
    if isinstance(node, ast.expr) and (chain := _dotted(node)):
        yield chain
        return
    if isinstance(node, ast.Call) and _dotted(node.func).rpartition(".")[2] in _DYNAMIC_IMPORTS and node.args:
        if isinstance(name := node.args[0], ast.Constant) and isinstance(name.value, str):
            yield f"{_AT_RUN_TIME}{name.value}"
    elif isinstance(node, ast.AnnAssign):
        yield from _names_of_annotation(node.annotation)
    for child in ast.iter_child_nodes(node):
        yield from _names_in(child)


def _names_of_annotation(node: ast.expr) -> Iterator[str]:
    """Yield the dotted names in an annotation, also in strings."""
    yield from _names_in(node)
    for inner in ast.walk(node):
        if isinstance(inner, ast.Constant) and isinstance(inner.value, str):
            with suppress(SyntaxError):  # not an expression, as in Annotated[int, "of the grid"]
                yield from _names_in(ast.parse(inner.value, mode="eval"))


def _dotted(node: ast.expr) -> str:
    """Return `a.b.c` for an expression of this form, otherwise an empty string."""
    names: list[str] = []
    while isinstance(node, ast.Attribute):
        names.append(node.attr)
        node = node.value
    return ".".join([node.id, *reversed(names)]) if isinstance(node, ast.Name) else ""


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
