"""Find what a Python file defines, and what each definition refers to, without importing it."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from pano_mvs.core.digest import digest_from_bytes, digest_from_value
from pano_mvs.engine.code.canonical import canonical_text, strip
from pano_mvs.engine.code.references import Import, dotted, references_of

_STAGE_DECORATORS = frozenset(
    f"pano_mvs.{module}.{name}" for module in ("api", "engine.stages.stage") for name in ("stage", "source")
)
"""These do not count: their arguments are already in the key of the stage, or cannot affect its result."""

_PURE_DECORATORS = frozenset(
    {
        "kernel",
        "inlined",
        "njit",
        "jit",
        "vectorize",
        "guvectorize",
        "intrinsic",
        "dataclass",
        "cache",
        "lru_cache",
        "contextmanager",
        "total_ordering",
        "wraps",
        "runtime_checkable",
        "final",
        "unique",
        "params_from",
        "checks_settings",
    }
)
"""These do not register anything; other decorators might."""


@dataclass(frozen=True, slots=True)
class Definition:
    """A top-level function, class or variable, or everything that a module executes when it is imported.

    Attributes:
        digest: of its code.
        uses: references, see `references.ABSOLUTE`.
        annotations: references only in annotations that do not affect results.
        loads: dotted paths that it imports when it runs.
    """

    digest: str
    uses: tuple[str, ...]
    annotations: tuple[str, ...] = ()
    loads: tuple[str, ...] = ()


@dataclass(slots=True)
class ModuleSummary:
    """The contents of a module.

    Attributes:
        definitions: by name.
        bindings: imported name to the path that it refers to: `package.module`, or `package.module:name`.
        stars: modules from which all names are imported.
        effects: what it executes on import beside definitions; None if nothing.
        effect_names: names that these statements define.
        loads: dotted paths that importing it imports.
    """

    definitions: dict[str, Definition] = field(default_factory=dict)
    bindings: dict[str, str] = field(default_factory=dict)
    stars: list[str] = field(default_factory=list)
    effects: Definition | None = None
    effect_names: list[str] = field(default_factory=list)
    loads: list[str] = field(default_factory=list)

    def to_json(self) -> list[Any]:
        """Return the summary as JSON values."""
        definitions = {name: _to_json(one) for name, one in self.definitions.items()}
        effects = None if self.effects is None else _to_json(self.effects)
        return [definitions, self.bindings, self.stars, effects, self.effect_names, self.loads]

    @staticmethod
    def from_json(value: Sequence[Any]) -> ModuleSummary:
        """Return the summary from the result of `to_json`."""
        definitions, bindings, stars, effects, effect_names, loads = value
        return ModuleSummary(
            {name: _from_json(one) for name, one in definitions.items()},
            bindings,
            stars,
            None if effects is None else _from_json(effects),
            effect_names,
            loads,
        )


def _to_json(one: Definition) -> list[str]:
    return [one.digest, *(" ".join(names) for names in (one.uses, one.annotations, one.loads))]


def _from_json(value: Sequence[str]) -> Definition:
    digest, uses, annotations, loads = value
    return Definition(digest, tuple(uses.split()), tuple(annotations.split()), tuple(loads.split()))


def summarize_module(text: str | bytes, module: str, *, is_package: bool = False) -> ModuleSummary:
    """Return the summary of a module.

    Args:
        text: the source.
        module: dotted name, from which relative imports start.
        is_package: whether it is the `__init__.py` of a package.

    Raises:
        SyntaxError: if the text is not Python.
        ValueError: if it contains a null character.
    """
    summarizer = _Summarizer(module if is_package else module.rpartition(".")[0])
    return summarizer.summarize(ast.parse(text))


class _Summarizer:
    def __init__(self, package: str) -> None:
        self._package = package
        self._summary = ModuleSummary()
        self._named: dict[str, list[ast.stmt]] = {}
        self._effects: list[ast.stmt] = []

    def summarize(self, tree: ast.Module) -> ModuleSummary:
        for statement in tree.body:
            self._sort(statement)
        definitions = {id(one): self._definition(one) for one in tree.body}
        for name, statements in self._named.items():
            self._summary.definitions[name] = _joined([definitions[id(one)] for one in statements])
        if self._effects:
            self._summary.effects = _joined([definitions[id(one)] for one in self._effects])
        return self._summary

    def _sort(self, statement: ast.stmt) -> None:
        """Enter a top-level statement as an import, a definition, or an effect of the import."""
        match statement:
            case ast.Import() | ast.ImportFrom():
                self._bind(statement)
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                self._named.setdefault(statement.name, []).append(statement)
                if not all(self._is_pure(decorator) for decorator in statement.decorator_list):
                    self._effects.append(statement)  # the decorator may register it somewhere
            case ast.Assign() | ast.AnnAssign() | ast.AugAssign() if names := _assigned_names(statement):
                for name in names:
                    self._named.setdefault(name, []).append(statement)
            case ast.If(test=ast.Name(id="TYPE_CHECKING") | ast.Attribute(attr="TYPE_CHECKING")):
                for inner in ast.walk(statement):
                    if isinstance(inner, ast.Import | ast.ImportFrom):
                        self._bind(inner, loads=False)
            case ast.Pass() | ast.Expr(value=ast.Constant()):
                pass
            case _:
                self._effects.append(statement)
                self._summary.effect_names.extend(_names_defined_in(statement))
                for inner in ast.walk(statement):
                    if isinstance(inner, ast.Import | ast.ImportFrom):
                        self._bind(inner)

    def _bind(self, statement: Import, *, loads: bool = True) -> None:
        for name, path in self._bindings_of(statement).items():
            if name == "*":
                self._summary.stars.append(path)
            else:
                self._summary.bindings[name] = path
        if loads:
            self._summary.loads.extend(self._loaded_by(statement))

    def _bindings_of(self, statement: Import) -> dict[str, str]:
        return dict(self._bound(statement))

    def _bound(self, statement: Import) -> Iterator[tuple[str, str]]:
        for alias in statement.names:
            if isinstance(statement, ast.ImportFrom):
                base = self._base_of(statement)
                yield (alias.asname or alias.name), base if alias.name == "*" else f"{base}:{alias.name}"
            elif alias.asname:
                yield alias.asname, alias.name
            else:
                yield alias.name.partition(".")[0], alias.name.partition(".")[0]

    def _loaded_by(self, statement: Import) -> list[str]:
        if isinstance(statement, ast.Import):
            return [alias.name for alias in statement.names]
        base = self._base_of(statement)
        return [base if alias.name == "*" else f"{base}.{alias.name}" for alias in statement.names]

    def _base_of(self, statement: ast.ImportFrom) -> str:
        """Return the absolute dotted path of the module from which names are imported."""
        if not statement.level:
            return statement.module or ""
        parts = self._package.split(".")
        above = parts[: len(parts) - (statement.level - 1)]
        return ".".join([*above, statement.module] if statement.module else above)

    def _is_pure(self, decorator: ast.expr) -> bool:
        path = self._path_of(decorator)
        return path in _STAGE_DECORATORS or path.rpartition(".")[2] in _PURE_DECORATORS

    def _path_of(self, decorator: ast.expr) -> str:
        """Return the dotted path of a decorator, resolved with the imports of the module."""
        chain = dotted(decorator.func if isinstance(decorator, ast.Call) else decorator)
        root, _, rest = chain.partition(".")
        path = self._summary.bindings.get(root, root).replace(":", ".")
        return f"{path}.{rest}" if rest else path

    def _definition(self, statement: ast.stmt) -> Definition:
        if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef):
            declares = {one for one in statement.decorator_list if self._path_of(one) in _STAGE_DECORATORS}
            statement.decorator_list = [one for one in statement.decorator_list if one not in declares]
        found = references_of(statement, self._bindings_of)
        module = ast.Module(body=[statement], type_ignores=[])
        strip(module)
        return Definition(
            digest_from_bytes(canonical_text(module).encode("utf-8", "surrogatepass")),
            tuple(sorted(found.used)),
            tuple(sorted(found.annotations - found.used)),
            tuple(sorted({path for one in found.imports for path in self._loaded_by(one)})),
        )


def _joined(definitions: Sequence[Definition]) -> Definition:
    if len(definitions) == 1:
        return definitions[0]
    return Definition(
        digest_from_value([one.digest for one in definitions]),
        tuple(sorted({name for one in definitions for name in one.uses})),
        tuple(sorted({name for one in definitions for name in one.annotations})),
        tuple(sorted({name for one in definitions for name in one.loads})),
    )


def _assigned_names(statement: ast.Assign | ast.AnnAssign | ast.AugAssign) -> list[str]:
    """Return the names that an assignment defines; none if it also sets an attribute or an element."""
    names: list[str] = []
    pending: list[ast.expr] = list(statement.targets) if isinstance(statement, ast.Assign) else [statement.target]
    while pending:
        target = pending.pop()
        match target:
            case ast.Name():
                names.append(target.id)
            case ast.Tuple() | ast.List():
                pending.extend(target.elts)
            case ast.Starred():
                pending.append(target.value)
            case _:
                return []
    return names


def _names_defined_in(statement: ast.stmt) -> Iterator[str]:
    for node in ast.walk(statement):
        match node:
            case ast.Name(id=name, ctx=ast.Store()):
                yield name
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
