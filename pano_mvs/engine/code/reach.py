"""Follow code by name, from a function to everything that it may use in the modules of some packages.

Nodes are definitions: the functions, classes and variables at the top level of a module. Names computed at run time
(`getattr` on a module, imports by a computed name) are not followed; a module that is used as a value counts as a
whole. What a module does when it is imported counts wherever the module is loaded.
"""

from __future__ import annotations

import builtins
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from pano_mvs.core.digest import digest_from_value
from pano_mvs.engine.code.references import ABSOLUTE
from pano_mvs.engine.code.sources import Sources
from pano_mvs.engine.code.summary import Definition, ModuleSummary

_IMPORT, _WHOLE = "<import>", "<all>"
_MAX_DEPTH = 50


@dataclass(frozen=True, slots=True)
class Reach:
    """The code that a function reaches.

    Attributes:
        digest: of all definitions.
        definitions: `module:name` of each definition, to its digest.
        libraries: top-level names of other packages that these use, except the standard library.
    """

    digest: str
    definitions: dict[str, str]
    libraries: frozenset[str]


@dataclass(slots=True)
class _Node:
    digest: str
    targets: set[str] = field(default_factory=set)
    libraries: set[str] = field(default_factory=set)


class CodeGraph:
    """The graph of definitions and the definitions that they use, built on demand.

    Attributes:
        sources: the modules that are followed.
    """

    def __init__(self, sources: Sources, *, left_out: Iterable[str] = (), kept: Iterable[str] = ()) -> None:
        """Create an empty graph.

        Args:
            sources: the modules that are followed; all others are libraries.
            left_out: dotted names of packages and modules that are ignored.
            kept: modules inside these that count nevertheless.
        """
        self.sources = sources
        self._is_out = dict.fromkeys(left_out, True) | dict.fromkeys(kept, False)
        self._nodes: dict[str, _Node] = {}
        self._modules: dict[str, tuple[str, ...]] = {}

    def with_modules(self, known: Mapping[str, ModuleSummary]) -> CodeGraph:
        """Return the graph of these modules and some others, which the present ones do not use."""
        more = CodeGraph(self.sources.with_modules(known))
        more._is_out, more._nodes, more._modules = dict(self._is_out), dict(self._nodes), dict(self._modules)
        return more

    def reach_of(self, paths: Iterable[str], *, with_annotations: bool = False) -> Reach:
        """Return some definitions or modules and everything that they use.

        Args:
            paths: `package.module:name`, or `package.module:` for a whole module.
            with_annotations: whether types in their annotations count too, as the kinds in those of a stage do.
        """
        libraries: set[str] = set()
        pending: set[str] = set()
        for path in paths:
            targets = self._targets(path, libraries)
            pending.update(targets)
            for target in targets if with_annotations else ():
                pending.update(self._annotations(target, libraries))
        reached: dict[str, str] = {}
        while pending:
            name = pending.pop()
            if name not in reached:
                node = self._node(name)
                reached[name] = node.digest
                libraries |= node.libraries
                pending.update(node.targets - reached.keys())
        reached = {name: reached[name] for name in sorted(reached) if reached[name]}
        digest = digest_from_value([f"{name} {digest}" for name, digest in reached.items()])
        return Reach(digest, reached, frozenset(libraries))

    def _node(self, name: str) -> _Node:
        if name not in self._nodes:
            module, _, what = name.partition(":")
            summary = self.sources.summary(module)
            assert summary is not None, name
            if what == _IMPORT:
                self._nodes[name] = self._import_node(module, summary)
            elif what == _WHOLE:
                self._nodes[name] = _Node("", {f"{module}:{one}" for one in (_IMPORT, *summary.definitions)})
            else:
                self._nodes[name] = self._definition_node(module, summary, summary.definitions[what])
        return self._nodes[name]

    def _definition_node(self, module: str, summary: ModuleSummary, definition: Definition) -> _Node:
        node = _Node("", {f"{module}:{_IMPORT}"})
        edges: list[list[str]] = []
        for reference in definition.uses:
            path = _absolute(reference, module, summary)
            if path:
                targets = self._targets(path, node.libraries)
                node.targets.update(targets)
                edges.append([reference, *(sorted(targets) or [path])])
        for path in definition.loads:
            node.targets.update(self._imports(path))
        # Include what names refer to: another import of the same name changes what is called.
        node.digest = digest_from_value([definition.digest, edges])
        return node

    def _import_node(self, module: str, summary: ModuleSummary) -> _Node:
        """Return the node for the import of a module: the statements that it executes, and its own imports."""
        node = _Node("")
        if summary.effects is not None:
            node = self._definition_node(module, summary, summary.effects)
            node.libraries.clear()  # what a module only loads does not depend on the version of a library
        for path in (module, *summary.loads):
            node.targets.update(self._imports(path))
        return node

    def _imports(self, path: str) -> list[str]:
        """Return the import nodes of the modules on a dotted path."""
        modules = self._modules_on(path) if path in self.sources else ()
        return [f"{module}:{_IMPORT}" for module in modules if not self._is_left_out(module)]

    def _annotations(self, target: str, libraries: set[str]) -> set[str]:
        module, _, name = target.partition(":")
        summary = self.sources.summary(module)
        if summary is None:
            return set()
        found = [one for own, one in summary.definitions.items() if name in (own, _WHOLE)]
        paths = (_absolute(reference, module, summary) for one in found for reference in one.annotations)
        return {one for path in paths if path for one in self._targets(path, libraries)}

    def _modules_on(self, path: str) -> tuple[str, ...]:
        """Return the modules on a dotted path, from the top down."""
        if path not in self._modules:
            above, _, _ = path.rpartition(".")
            modules = self._modules_on(above) if above else ()
            is_next = (modules[-1] if modules else "") == above
            found = is_next and self.sources.summary(path) is not None
            self._modules[path] = (*modules, path) if found else modules
        return self._modules[path]

    def _targets(self, path: str, libraries: set[str], depth: int = 0) -> tuple[str, ...]:
        """Return the nodes that a path refers to; if it leads out of the packages, add the library instead."""
        top = path.replace(":", ".").partition(".")[0]
        if top not in self.sources:
            if top and top not in sys.stdlib_module_names:
                libraries.add(top)
            return ()
        module, _, rest = path.partition(":") if ":" in path else path.partition(".")
        while (summary := self.sources.summary(module)) is not None:
            if self._is_left_out(module):
                return ()
            if not rest:
                return (f"{module}:{_WHOLE}",)
            name, _, further = rest.partition(".")
            if name in summary.definitions:
                return (f"{module}:{name}",)
            bound = summary.bindings.get(name, "")
            if bound and bound != f"{module}:{name}" and depth < _MAX_DEPTH:
                return self._targets(_joined(bound, further), libraries, depth + 1)
            if self.sources.summary(f"{module}.{name}") is None:
                return self._targets_of_unbound(module, summary, name, libraries=libraries, depth=depth)
            module, rest = f"{module}.{name}", further
        libraries.add(top)  # such as compiled modules
        return ()

    def _targets_of_unbound(
        self, module: str, summary: ModuleSummary, name: str, *, libraries: set[str], depth: int
    ) -> tuple[str, ...]:
        """Return the nodes of a name that a module neither defines nor imports explicitly."""
        if name in summary.effect_names:
            return (f"{module}:{_IMPORT}",)
        for star in summary.stars:
            if star not in self.sources:
                libraries.add(star.partition(".")[0])
                continue
            other = self.sources.summary(star)
            known = other is not None and (name in other.definitions or name in other.bindings or other.stars)
            if known and depth < _MAX_DEPTH:
                return self._targets(f"{star}:{name}", libraries, depth + 1)
        return () if name in vars(builtins) else (f"{module}:{_WHOLE}",)

    def _is_left_out(self, module: str) -> bool:
        if module not in self._is_out:
            above, _, _ = module.rpartition(".")
            self._is_out[module] = bool(above) and self._is_left_out(above)
        return self._is_out[module]


def _absolute(reference: str, module: str, summary: ModuleSummary) -> str:
    """Return the path of a reference; empty for builtins."""
    if reference.startswith(ABSOLUTE):
        return reference[len(ABSOLUTE) :]
    root, _, rest = reference.partition(".")
    if root in summary.definitions or root in summary.effect_names:
        return f"{module}:{reference}"
    if root in summary.bindings:
        return _joined(summary.bindings[root], rest)
    return f"{module}:{reference}" if summary.stars else ""


def _joined(path: str, rest: str) -> str:
    return f"{path}.{rest}" if rest else path
