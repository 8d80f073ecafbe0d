"""A mapping whose values are loaded on access."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from typing import Generic, TypeVar

Key = TypeVar("Key")
Ref = TypeVar("Ref")
Value = TypeVar("Value")


class LazyMapping(Mapping[Key, Value], Generic[Key, Ref, Value]):
    """A mapping that loads values on access and keeps only the latest ones, so that not all need fit into memory.

    Iteration over keys, length and membership load nothing.

    Args:
        refs: key to the reference that `load` takes, in the order of iteration.
        load: reads one value; its exceptions are raised by the access.
        max_kept: number of values to keep.
    """

    def __init__(self, refs: Mapping[Key, Ref], load: Callable[[Ref], Value], *, max_kept: int = 64) -> None:
        """Create the mapping; nothing is loaded yet."""
        self._max_kept = max_kept
        self._refs = refs
        self._load = load
        self._latest: OrderedDict[Key, Value] = OrderedDict()

    def __getitem__(self, key: Key) -> Value:
        """Return a value, loading it unless it is among the latest ones."""
        if key in self._latest:
            self._latest.move_to_end(key)
            return self._latest[key]
        value = self._latest[key] = self._load(self._refs[key])
        if len(self._latest) > self._max_kept:
            self._latest.popitem(last=False)
        return value

    def __contains__(self, key: object) -> bool:
        """Return whether a key exists, without loading its value."""
        return key in self._refs

    def __iter__(self) -> Iterator[Key]:
        """Iterate over the keys."""
        return iter(self._refs)

    def __len__(self) -> int:
        """Return the number of items."""
        return len(self._refs)
