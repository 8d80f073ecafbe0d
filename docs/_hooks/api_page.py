"""The reference of pano_mvs.api for the authors of plugins, from its docstrings."""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Callable
from itertools import pairwise
from types import ModuleType
from typing import Any

from markdown_text import docstring

from pano_mvs import api
from pano_mvs.engine.stages.stage import Cardinality
from pano_mvs.scene import Record

_INTRODUCTION = """# API for plugins

This page is generated from the docstrings of `pano_mvs.api`; [Plugins](../plugins.md) shows how to use it. To run
workflows from Python, see [Python](../python.md)."""

_CARDINALITIES = {
    "One": "`x: One[K]`: the single `K` of the capture, such as `Poses`.",
    "Each": "`x: Each[K]`: the `K` of the image, pair or view of this call. `Each[K] | None` may stay unconnected.",
    "Near": "`x: Near[K]`: a list of the `K` of its neighbours, in order; for a pair, of both images.",
    "All": "`x: All[K]`: a mapping from names to the `K` of all items; values are loaded on access.",
}


_GROUPS = {
    "Declaring": ("stage", "source"),
    "What a stage is given": ("Params", "Context", "SourceItem"),
    "What a stage reads": (*_CARDINALITIES, "Names"),
    "Geometry": (
        "Rigid3",
        "Similarity3",
        "ray_grid",
        "ray_from_pixel",
        "pixel_from_ray",
        "sample_panorama",
        "pad_panorama",
        "roll_panorama",
    ),
    "Pairs": ("verify_pair",),
    "Groups and frames": (
        "split_groups",
        "join_groups",
        "per_group",
        "group_file",
        "lla_from_local",
        "WorldAxes",
    ),
    "Clouds": ("PointSelection", "select_points", "KeptPoints", "chunks", "CHUNK_POINTS"),
    "Settings": ("NOT_IN_KEY", "InputPath", "SourcePath", "RegisteredIn", "NamedRegistry"),
    "Parts of the sweep": ("register_sweep_cost", "CostWindow", "register_sweep_backend", "SweepInput", "Winners"),
}


def api_page() -> str:
    """Return the page."""
    listed = {name for names in _GROUPS.values() for name in names}
    rest = [name for name in api.__all__ if name not in listed]
    kinds = [name for name in rest if _derives(name, Record)]
    errors = [name for name in rest if _derives(name, Exception)]
    groups = _GROUPS | {"Kinds": tuple(kinds), "Errors": tuple(errors)}
    groups["Files and pictures"] = tuple(name for name in rest if name not in (*kinds, *errors))
    parts = [_INTRODUCTION]
    for title, names in groups.items():
        parts += [f"## {title}", *(_entry(name, getattr(api, name)) for name in names)]
    return "\n\n".join(parts) + "\n"


def _derives(name: str, base: type) -> bool:
    value = getattr(api, name)
    return isinstance(value, type) and issubclass(value, base)


def _entry(name: str, value: Any) -> str:
    return f"### {name} {{ #{name.lower()} }}\n\n{_body(name, value)}"


def _body(name: str, value: Any) -> str:
    if name in Cardinality.__members__.values() and name in _CARDINALITIES:
        return _CARDINALITIES[name]
    if inspect.isfunction(value):
        return f"```python\n{name}{_signature(value)}\n```\n\n{docstring(value.__doc__ or '')}"
    if isinstance(value, type):
        methods = [_method(member) for member in _own_methods(value)]
        return "\n\n".join([docstring(inspect.getdoc(value) or ""), *methods])
    return docstring(_string_after(name))


def _own_methods(value: type) -> list[Any]:
    """Return the public methods and properties that a class defines and describes, in the order of its source."""
    if issubclass(value, Exception):
        return []
    members = [
        member.__func__ if isinstance(member, staticmethod | classmethod) else member
        for name, member in vars(value).items()
        if not name.startswith("_")
    ]
    return [member for member in members if isinstance(member, property) or inspect.isfunction(member)]


def _method(member: Any) -> str:
    function: Any = member.fget if isinstance(member, property) else member
    shown = "" if isinstance(member, property) else _signature(function)
    body = docstring(function.__doc__ or "").replace("\n", "\n    ")
    return f"`{function.__name__}{shown}`\n\n:   {body}"


class _Bare(str):
    """An annotation that is shown without the quotes that a postponed one has."""

    def __repr__(self) -> str:
        return str(self)


def _signature(function: Callable[..., Any]) -> str:
    """Return the arguments and the result of a function, as they are written."""
    signature = inspect.signature(function)
    arguments = [
        argument.replace(annotation=_Bare(argument.annotation)) if isinstance(argument.annotation, str) else argument
        for name, argument in signature.parameters.items()
        if name not in ("self", "cls")
    ]
    result = signature.return_annotation
    return str(signature.replace(parameters=arguments, return_annotation=_Bare(result)))


def _string_after(name: str) -> str:
    """Return the string that stands under the assignment of a name, in the module that assigns it."""
    for module in _modules():
        body = ast.parse(inspect.getsource(module)).body
        for statement, following in pairwise(body):
            if name in _assigned(statement) and isinstance(following, ast.Expr):
                return str(ast.literal_eval(following.value))
    raise LookupError(f"{name} of pano_mvs.api is not documented")


def _modules() -> list[ModuleType]:
    return [
        module for name, module in sorted(sys.modules.items()) if name.startswith(("pano_mvs.engine.", "pano_mvs.io."))
    ]


def _assigned(statement: ast.stmt) -> list[str]:
    if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
        return [statement.target.id]
    if isinstance(statement, ast.Assign):
        return [target.id for target in statement.targets if isinstance(target, ast.Name)]
    return []
