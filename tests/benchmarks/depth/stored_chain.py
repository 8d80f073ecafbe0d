"""Run the dense stages of a workflow for a few references of a capture; the maps of depth stages are stored."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pano_mvs.core.digest import digest_from_value
from pano_mvs.engine.stages.ports import Cardinality
from pano_mvs.engine.stages.stage_code import stage_code
from pano_mvs.scene import Poses, RangeMap, Record, Views
from tests.benchmarks.captures import Capture
from tests.benchmarks.dense_chain import DenseChain, DenseRun, given_records, true_poses

# Prefixes of the stages whose maps are stored; the others are cheap.
_STORED = "depth."


class StoredChain:
    """The dense stages of a workflow, which run for some references and for what these depend on.

    Maps of the depth stages are stored in a folder by settings and code of the stage and of all stages before it, so
    that settings of the filters can be compared without another sweep.
    """

    def __init__(self, workflow: str, *, overrides: Sequence[str] = (), store: Path | None = None) -> None:
        self.chain = DenseChain(workflow, overrides=overrides)
        self.store = store

    def key(self, name: str | None = None) -> str:
        """Return a digest of settings and code of a stage and all dense stages before it; of all, without a name."""
        last = len(self.chain.dense) if name is None else self.chain.dense.index(name) + 1
        stages = [(stage, self.chain.stages[stage]) for stage in (*self.chain.dense[:last], *self._selectors())]
        return digest_from_value(
            [
                [stage, entry.spec.name, entry.params.model_dump_json(), stage_code(entry.spec, entry.params).digest]
                for stage, entry in stages
            ]
        )[:16]

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
            for image in images:
                done.results[name][image] = self._stored(label, name, image) or self._run_one(
                    label, name, image, index, given, done
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

    def _path(self, label: str, name: str, image: str) -> Path | None:
        if self.store is None or not self.chain.stages[name].spec.name.startswith(_STORED):
            return None
        return self.store / f"{label}-{self.key(name)}-{name}-{Path(image).stem}.npz"

    def _stored(self, label: str, name: str, image: str) -> RangeMap | None:
        path = self._path(label, name, image)
        if path is None or not path.is_file():
            return None
        with np.load(path) as arrays:
            return RangeMap(arrays["range"], arrays["confidence"])

    def _run_one(
        self,
        label: str,
        name: str,
        image: str,
        index: Views,
        given: Mapping[type[Record], dict[str, object]],
        done: DenseRun,
    ) -> Record:
        found = self.chain.run_one(name, image, index, given, done)
        path = self._path(label, name, image)
        if path is not None and isinstance(found, RangeMap):
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez(path, range=found.range, confidence=found.confidence)
        return found
