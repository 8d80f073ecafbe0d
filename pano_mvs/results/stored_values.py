"""The values of a run in the cache. Nothing is recomputed; deleted values are missing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, StoreError
from pano_mvs.core.paths import is_file, resolved
from pano_mvs.engine.cache.store import ItemRef, Store
from pano_mvs.engine.running.run import Run
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import Panorama, PointCloud, Poses, RangeMap, Record, TwoView
from pano_mvs.scene.panorama import StaticMasks

ROLES: Mapping[str, type[Record]] = {
    "images": Panorama,
    "pairs": TwoView,
    "poses": Poses,
    "ranges": RangeMap,
    "cloud": PointCloud,
    "static": StaticMasks,
}
"""The kinds of the final values of a run by role; run.json says which stage made each."""

_Kind = TypeVar("_Kind", bound=Record)


@dataclass(frozen=True)
class StoredValues:
    """The values of one run."""

    store: Store | None = None  # the cache; None if it is unknown or was deleted
    # role to item to the stored value; see `ROLES`. The only item of a role such as `poses` is called "".
    refs: Mapping[str, Mapping[str, ItemRef]] = field(default_factory=dict)
    # values that could not be read, with the reason; grows as values are loaded
    notes: list[str] = field(default_factory=list)

    @staticmethod
    def of_run(run: Run, stages: Mapping[str, str]) -> StoredValues:
        """Return the values of a run in this process.

        Args:
            run: the run, finished or not.
            stages: role to the stage that made it.
        """
        refs = {role: run.states[stage].items for role, stage in stages.items() if stage in run.states}
        return StoredValues(run.store, refs)

    @staticmethod
    def of_folder(out: Path, summary: RunSummary, store: Store) -> StoredValues:
        """Return the values of the latest run into a folder, using the list of runs in the cache.

        Raises:
            StoreError: if the list of runs is damaged.
        """
        own = str(resolved(out))
        entry = next((run for run in store.runs.entries() if run.out == own and not run.pinned), None)
        if entry is None:
            return StoredValues(notes=[f"the cache {store.root} contains no run into {out}, so images are missing"])
        stages = {role: stage for role, stage in summary.results.items() if role in ROLES}
        refs = {role: _Recorded(store, entry.keys.get(stage, {})) for role, stage in stages.items()}
        last = summary.results.get("images")  # the source, or a stage that masks its images
        sources = [stage for stage in summary.stages if stage.name == last or stage.use.startswith("source.")]
        folder = next((stage.params["path"] for stage in sources if stage.params.get("path")), None)
        read = {digest: Path(path) for path, digest in summary.inputs.items()}
        for name, ref in refs.get("images", {}).items() if folder else ():
            external = [part.digest for part in ref.parts.values() if part.external]
            # A scene of a tour has a title, which may be the name of the file of another scene.
            path = next((read[one] for one in external if one in read and is_file(read[one])), None)
            path = path or summary.source_file(name, Path(str(folder)))
            if external and path is not None:
                store.blobs.register_external(path)
        return StoredValues(store, refs)

    @property
    def poses(self) -> Poses | None:
        """The poses with which the ranges were computed."""
        return self._load("poses", "", Poses)

    @property
    def cloud(self) -> PointCloud | None:
        """The fused cloud."""
        return self._load("cloud", "", PointCloud)

    @property
    def static_masks(self) -> StaticMasks | None:
        """What moves with the cameras."""
        return self._load("static", "", StaticMasks)

    def panorama(self, name: str) -> Panorama | None:
        """Return a panorama, whose pixels are decoded on access."""
        return self._load("images", name, Panorama)

    def range_map(self, name: str) -> RangeMap | None:
        """Return the final range map of a view."""
        return self._load("ranges", name, RangeMap)

    def ranges(self, name: str) -> NDArray[np.float32] | None:
        """Return the ranges (H, W) of the final range map of a view, without reading the rest of it."""
        part = self._part("ranges", name, "range")
        return part if isinstance(part, np.ndarray) else None

    def confidence(self, name: str) -> NDArray[np.uint8] | None:
        """Return the confidence (H, W) of the final range map of a view, without reading the rest of it."""
        part = self._part("ranges", name, "confidence")
        return part if isinstance(part, np.ndarray) else None

    def sky(self, name: str) -> NDArray[np.bool_] | None:
        """Return the sky (H, W) of the final range map of a view; None if none was looked for."""
        part = self._part("ranges", name, "sky")
        return part if isinstance(part, np.ndarray) else None

    def pair_reason(self, name: str) -> str:
        """Return why a pair has no two-view geometry, or "" if unknown."""
        meta = self._part("pairs", name, "meta")
        return str(meta.get("reason", "")) if isinstance(meta, dict) else ""

    def digest(self, role: str, name: str = "") -> str:
        """Return the digest of a value, or "" if there is none."""
        ref = self.refs.get(role, {}).get(name)
        return ref.digest if ref is not None else ""

    def _part(self, role: str, name: str, part: str) -> Any:
        ref = self.refs.get(role, {}).get(name)
        if self.store is None or ref is None or part not in ref.parts:
            return None
        try:
            return self.store.blobs.get(ref.parts[part])
        except StoreError as error:
            self.notes.append(str(error))
            return None

    def _load(self, role: str, name: str, kind: type[_Kind]) -> _Kind | None:
        ref = self.refs.get(role, {}).get(name)
        if self.store is None or ref is None:
            return None
        try:
            value = self.store.load(ref, kind)
        except (StoreError, InputError) as error:
            self.notes.append(str(error))
            return None
        return value if isinstance(value, kind) else None


class _Recorded(Mapping[str, ItemRef]):
    """Item to its stored value, whose record is read on access, because the page shows only few of many pairs."""

    def __init__(self, store: Store, keys: Mapping[str, str]) -> None:
        self._store = store
        self._keys = keys
        self._known: dict[str, ItemRef | None] = {}

    def __getitem__(self, item: str) -> ItemRef:
        if item not in self._known:
            record = self._store.read_record(self._keys[item])
            self._known[item] = record.output if record is not None else None
        found = self._known[item]
        if found is None:
            raise KeyError(item)
        return found

    def __iter__(self) -> Iterator[str]:
        return (item for item in self._keys if item in self)

    def __len__(self) -> int:
        return sum(1 for _ in self)
