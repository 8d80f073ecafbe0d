"""Units of work, and the state of a stage's units in a run or in a plan."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from pano_mvs.engine.cache.blobs import BlobRef
from pano_mvs.engine.cache.store import ItemRef
from pano_mvs.engine.stages.stage import Cardinality, SourceItem
from pano_mvs.engine.workflows.workflow import StageEntry
from pano_mvs.scene import Axis

WHOLE = ""  # the name of the unit of a stage that has only one
PENDING = ItemRef("", "0" * 32, {})  # placeholder for an item of which only the name is known
OF_CODE = frozenset({"code", "libraries"})
"""The parts of a unit's identity that describe the code that computes it."""

UnitInput: TypeAlias = "ItemRef | dict[str, ItemRef] | None"


@dataclass(frozen=True, slots=True)
class Unit:
    """One unit of work, for an image, a pair, a view, or the whole capture."""

    entry: StageEntry
    item: str  # its name within the stage; `WHOLE` if the stage has only one unit
    members: tuple[str, ...]  # the images that it concerns
    # port to the item that it reads, or to items by name for Near, All and Names
    inputs: Mapping[str, UnitInput]
    key: str
    identity: Mapping[str, Any]  # what the key is made of
    source: SourceItem | None = None  # the item to read, for units of a source

    @property
    def label(self) -> str:
        """The unit as messages show it: `stage:item`."""
        return f"{self.entry.name}:{self.item}" if self.item else self.entry.name

    def input_blobs(self) -> Iterator[BlobRef]:
        """Yield the blobs of all inputs that the unit loads: of a `Names` port, it only sees the names."""
        by_name = {port.name for port in self.entry.spec.ports if port.cardinality is Cardinality.NAMES}
        for port, value in self.inputs.items():
            if port in by_name:
                continue
            items = [value] if isinstance(value, ItemRef) else (value or {}).values()
            for item in items:
                yield from item.parts.values()


@dataclass(slots=True)
class StageState:
    """The results of a stage, in a run or in a plan."""

    axis: Axis
    items: dict[str, ItemRef] = field(default_factory=dict)  # unit to its stored value
    # image to its item, where the value is a collection
    exploded: dict[str, ItemRef] = field(default_factory=dict)
    members: dict[str, tuple[str, ...]] = field(default_factory=dict)  # unit to the images that it concerns
    failed: dict[str, str] = field(default_factory=dict)  # unit to the reason why it has, or can have, no value
    pending: set[str] = field(default_factory=set)  # units that are not settled
    open: bool = False  # whether the list of units is not known yet
    # in a plan, unit to the images whose items it reads at `Near` ports
    near: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
