"""All items of a kind, loaded when they are asked for."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from typing import Generic, TypeVar

Key = TypeVar("Key")
Ref = TypeVar("Ref")
Value = TypeVar("Value")


class LazyMapping(Mapping[Key, Value], Generic[Key, Ref, Value]):
    """A mapping that loads a value on access and keeps the latest few, so that thousands need not fit in memory.

    Names, length and membership load nothing.

    Args:
        refs: key to what `load` turns into the value, in the order of iteration.
        load: reads one value; whatever it raises comes out of the access.
        kept: so many of the latest values are kept.
    """

    def __init__(self, refs: Mapping[Key, Ref], load: Callable[[Ref], Value], *, kept: int = 64) -> None:
        """Remember where the values are."""
        self._kept = kept
        self._refs = refs
        self._load = load
        self._latest: OrderedDict[Key, Value] = OrderedDict()

    def __getitem__(self, key: Key) -> Value:
        """Return a value, from the store unless it was asked for a moment ago."""
        if key in self._latest:
            self._latest.move_to_end(key)
            return self._latest[key]
        value = self._latest[key] = self._load(self._refs[key])
        if len(self._latest) > self._kept:
            self._latest.popitem(last=False)
        return value

    def __contains__(self, key: object) -> bool:
        """Return whether there is such an item, without loading it."""
        return key in self._refs

    def __iter__(self) -> Iterator[Key]:
        """Iterate over the keys."""
        return iter(self._refs)

    def __len__(self) -> int:
        """Return the number of items."""
        return len(self._refs)
