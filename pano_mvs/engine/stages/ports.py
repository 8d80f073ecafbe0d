"""The ports of a stage: how many items it reads of which kind, written as type annotations.

`Each[K]` is the unit's own item, `Near[K]` are the items of its neighbours in order, `All[K]` are all items by name,
and `One[K]` is the single value of a stage. `Names[K]` are only the names of all items: a stage that needs no more is
not computed again when the content of an item changes. A port annotated `Each[K] | None` may stay unconnected.
"""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any, Generic, TypeAlias, TypeVar, Union, get_args, get_origin

from pano_mvs.scene import Record


class Cardinality(StrEnum):
    """The number of items of a kind that one unit of work reads."""

    ONE = "One"
    EACH = "Each"
    NEAR = "Near"
    ALL = "All"
    NAMES = "Names"


K = TypeVar("K")

One: TypeAlias = Annotated[K, Cardinality.ONE]
Each: TypeAlias = Annotated[K, Cardinality.EACH]
Near: TypeAlias = Annotated[Sequence[K], Cardinality.NEAR]
All: TypeAlias = Annotated[Mapping[Any, K], Cardinality.ALL]
"""By image name; by (first, second) image names for kinds of the pair axis."""


class Names(tuple[str, ...], Generic[K]):
    """The names of all items of a kind, in the capture's order."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Port:
    """One typed input of a stage."""

    name: str
    kind: type[Record]
    cardinality: Cardinality
    optional: bool = False

    def __str__(self) -> str:
        """Return the port as it is annotated in code."""
        return f"{self.name}: {self.cardinality}[{self.kind.kind_name()}]{' | None' if self.optional else ''}"


def port_from_annotation(name: str, annotation: Any) -> Port | None:
    """Return the port that an annotation declares, or None if it does not declare one."""
    optional = False
    if get_origin(annotation) in (Union, types.UnionType):
        inner = [part for part in get_args(annotation) if part is not type(None)]
        if len(inner) != 1:
            return None
        annotation, optional = inner[0], True
    if get_origin(annotation) is Names:
        (kind,) = get_args(annotation)
        return Port(name, kind, Cardinality.NAMES, optional)
    if get_origin(annotation) is not Annotated:
        return None
    value_type, *marks = get_args(annotation)
    cardinality = next((mark for mark in marks if isinstance(mark, Cardinality)), None)
    if cardinality is None:
        return None
    if cardinality in (Cardinality.NEAR, Cardinality.ALL):
        value_type = get_args(value_type)[-1]
    if not (isinstance(value_type, type) and issubclass(value_type, Record)):
        return None
    return Port(name, value_type, cardinality, optional)
