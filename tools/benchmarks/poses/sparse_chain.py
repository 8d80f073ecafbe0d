"""Poses by the sparse stages of a workflow, run in memory; key points and matches are found once for all subsets."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.stage import Cardinality
from pano_mvs.engine.workflows.workflow import StageEntry
from pano_mvs.scene import Features, Panorama, Poses, TwoView
from pano_mvs.session.session import open_session
from tools.benchmarks.captures import Capture


class SparseChain:
    """The features, matches and poses of a workflow for captures of one place; all pairs are matched."""

    def __init__(self, workflow: str, *, overrides: Sequence[str] = ()) -> None:
        session = open_session(workflow, overrides=overrides)
        entries = [session.workflow.stages[name] for name in session.graph.order]
        self.extractor = next(entry for entry in entries if entry.spec.output is Features)
        self.matcher = next(entry for entry in entries if entry.spec.output is TwoView)
        self.solvers = [entry for entry in entries if entry.spec.output is Poses]
        self.cpu_s = 0.0
        self._features: dict[str, Features] = {}
        self._pairs: dict[tuple[str, str], TwoView] = {}

    def poses(self, capture: Capture) -> Poses:
        """Return the poses of the pictures of a capture, in the order of its names."""
        started = time.process_time()
        names = list(capture.panoramas)
        for name in names:
            if name not in self._features:
                ports = {port.name: capture.panoramas[name] for port in self.extractor.spec.ports}
                self._features[name] = _call(self.extractor, ports)
        pairs = list(combinations(names, 2))
        for pair in pairs:
            if pair not in self._pairs:
                both = {port.name: [self._features[name] for name in pair] for port in self.matcher.spec.ports}
                self._pairs[pair] = _call(self.matcher, both)
        poses = None
        for solver in self.solvers:
            poses = _call(solver, self._given(solver, capture, pairs, poses))
        assert isinstance(poses, Poses)
        self.cpu_s += time.process_time() - started
        return poses

    def _given(
        self, entry: StageEntry, capture: Capture, pairs: Sequence[tuple[str, str]], poses: Poses | None
    ) -> dict[str, Any]:
        values: dict[type, Any] = {
            Features: {name: self._features[name] for name in capture.panoramas},
            TwoView: {pair: self._pairs[pair] for pair in pairs},
            Panorama: dict(capture.panoramas),
            Poses: poses,
        }
        return {
            port.name: tuple(capture.panoramas) if port.cardinality is Cardinality.NAMES else values[port.kind]
            for port in entry.spec.ports
        }


def _call(entry: StageEntry, ports: dict[str, Any]) -> Any:
    with tempfile.TemporaryDirectory() as scratch:
        context = Context(np.random.default_rng(0), Path(scratch))
        extras = {
            argument: {"params": entry.params, "ctx": context}[what]
            for argument, what in entry.spec.extras.items()
            if what != "item"
        }
        return entry.spec.function(**ports, **extras)
