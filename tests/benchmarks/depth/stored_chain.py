"""Run the dense stages of a workflow for a few references of a capture, and store maps that other settings share."""

from __future__ import annotations

import time
from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from pano_mvs.core.digest import digest_from_value
from pano_mvs.engine.stages.stage import Cardinality
from pano_mvs.engine.stages.stage_code import stage_code
from pano_mvs.scene import Poses, RangeMap, Record, Views
from tests.benchmarks.captures import Capture
from tests.benchmarks.dense_chain import DenseChain, DenseRun, given_records, true_poses
from tests.stored import write_npz

# Prefixes of the stages whose maps are stored; the others are cheap.
_STORED = "depth."


class StoredChain:
    """The dense stages of a workflow, which run for some references and for what these depend on.

    Maps of the depth stages are stored in a folder by settings, wiring and code of the stage and of all stages before
    it, so that settings of the filters can be compared without another sweep. With a dictionary as well, which several
    chains may share, the maps of all stages are kept in memory.
    """

    def __init__(
        self,
        workflow: str,
        *,
        overrides: Sequence[str] = (),
        store: Path | None = None,
        memory: MutableMapping[str, Record] | None = None,
    ) -> None:
        self.chain = DenseChain(workflow, overrides=overrides)
        self.store, self.memory = store, memory

    def key(self, name: str | None = None) -> str:
        """Return a digest of settings and code of a stage and all dense stages before it; of all, without a name."""
        last = len(self.chain.dense) if name is None else self.chain.dense.index(name) + 1
        return digest_from_value(
            [self.settings(stage) for stage in (*self.chain.dense[:last], *self._selectors())],
        )[:16]

    def settings(self, name: str) -> list[object]:
        """Return all that the result of a stage depends on, besides the results of other stages."""
        entry, edges = self.chain.stages[name], self.chain.graph.edges[name]
        wiring = sorted((port, edge.producer) for port, edge in edges.items())
        code = stage_code(entry.spec, entry.params).digest
        return [name, entry.spec.name, entry.params.model_dump_json(), code, [list(pair) for pair in wiring]]

    def run(self, capture: Capture, *, label: str, references: Sequence[str]) -> DenseRun:
        """Run the stages; each stage has results of the images that the references depend on.

        Args:
            capture: panoramas and true poses.
            label: name of the capture in the store, different for other panoramas of the same place.
            references: the images whose last maps are wanted.
        """
        poses = true_poses(capture)
        given, done = given_records(capture, poses), DenseRun()
        for name, images in self._needed(poses, references).items():
            index, started = self.chain.index(name, poses), time.process_time()
            done.results[name] = {}
            own = f"{label}-{self.key(name)}-{name}"
            for image in images:
                done.results[name][image] = self._stored(own, name, image) or self._run_one(
                    own, name, image, index=index, given=given, done=done
                )
            done.cpu_s[name] = time.process_time() - started
        return done

    def _selectors(self) -> list[str]:
        return [name for name, entry in self.chain.stages.items() if entry.spec.output is Views]

    def _needed(self, poses: Poses, references: Sequence[str]) -> dict[str, list[str]]:
        """Return the images that each stage has to be run for, in the order of the stages."""
        needed: dict[str, set[str]] = {name: set() for name in self.chain.dense}
        needed[self.chain.dense[-1]] |= set(references)
        for name in reversed(self.chain.dense):
            needed[name] |= set(references) if name == self.chain.dense[-1] else set()
            neighbours = self.chain.index(name, poses).neighbours
            for port in self.chain.stages[name].spec.ports:
                edge = self.chain.graph.edges[name].get(port.name)
                if edge is None or edge.producer not in needed:
                    continue
                own = needed[name]
                near = {other for image in own for other in neighbours[image]}
                needed[edge.producer] |= near if port.cardinality is Cardinality.NEAR else own
        return {name: sorted(images) for name, images in needed.items()}

    def _path(self, own: str, name: str, image: str) -> Path | None:
        if self.store is None or not self.chain.stages[name].spec.name.startswith(_STORED):
            return None
        return self.store / f"{own}-{Path(image).stem}.npz"

    def _stored(self, own: str, name: str, image: str) -> Record | None:
        if self.memory is not None and f"{own}-{image}" in self.memory:
            return self.memory[f"{own}-{image}"]
        path = self._path(own, name, image)
        if path is None or not path.is_file():
            return None
        with np.load(path) as arrays:
            return RangeMap(**{field: arrays[field] for field in arrays.files})

    def _run_one(
        self,
        own: str,
        name: str,
        image: str,
        *,
        index: Views,
        given: Mapping[type[Record], dict[str, object]],
        done: DenseRun,
    ) -> Record:
        found = self.chain.run_one(name, image, index, given, done)
        if self.memory is not None:
            self.memory[f"{own}-{image}"] = found
        path = self._path(own, name, image)
        if path is not None and isinstance(found, RangeMap):
            path.parent.mkdir(parents=True, exist_ok=True)
            arrays = {one.name: getattr(found, one.name) for one in fields(found)}
            write_npz(path, {field: array for field, array in arrays.items() if array is not None})
        return found
