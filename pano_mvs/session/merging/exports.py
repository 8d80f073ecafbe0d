"""Repeat the exports of a block for the merged capture: those that read nothing but the cloud and the poses."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pano_mvs.core.digest import digest_from_file
from pano_mvs.core.files import copy_file, temporary_prefix
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage import Cardinality, StageSpec
from pano_mvs.io.growing_arrays import GrowingArrays
from pano_mvs.io.ply import open_ply_points
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import Files, PointCloud, Poses
from pano_mvs.session.merging.files import MergeFiles

_MERGED = {"export.colmap", "export.ply", "export.ranges", "export.previews", "export.nerfstudio"}
_ARRAYS = ("points_in_world", "normals_in_world", "colors_rgb", "view_counts", "confidence", "uncertainty")


def repeat_exports(files: MergeFiles, block: RunSummary, *, has_cloud: bool) -> tuple[dict[str, str], list[str]]:
    """Write what the exports of a block make of the merged poses and cloud.ply; return file to digest, and notes.

    Args:
        files: whose model and cloud have been written.
        block: the run whose exports and settings are taken.
        has_cloud: whether cloud.ply has points.

    Raises:
        StoreError: if a file cannot be written.
    """
    stages = Registry.installed().stages
    found = [(outcome, stages[outcome.use]) for outcome in block.stages if outcome.use in stages]
    exports = [(outcome, spec) for outcome, spec in found if spec.output is Files and spec.name not in _MERGED]
    repeated = [(outcome, spec) for outcome, spec in exports if _reads_only(spec)]
    written: dict[str, str] = {}
    left_out = dict.fromkeys(spec.name for _, spec in exports if not _reads_only(spec))
    notes = [f"of each block, and not merged: the files of {', '.join(left_out)}"] if left_out else []
    if not repeated or not has_cloud:
        return written, notes
    with _merged_cloud(files.out) as (cloud, scratch):
        for number, (outcome, spec) in enumerate(repeated):
            ctx = Context(np.random.default_rng(0), scratch / f"export_{number}")
            ctx.scratch.mkdir()
            inputs: dict[str, object] = {
                port.name: cloud if port.kind is PointCloud else files.merged.poses for port in spec.ports
            }
            try:
                extras = {"params": spec.params_type.model_validate(outcome.params), "ctx": ctx}
                own = {name: extras[role] for name, role in spec.extras.items()}
                made = spec.function(**inputs, **own)
                made.check()
            except Exception as error:  # of a library or a plugin: nothing else is lost
                notes.append(f"{spec.name} was not repeated for the merged capture: {error}")
                continue
            assert isinstance(made, Files)
            for target, path in made.files.items():
                copy_file(path, files.to_write(target))
                written[target] = digest_from_file(path)
            notes += [f"{spec.name}: {note}" for note in ctx.notes]
    return written, notes


def _reads_only(spec: StageSpec) -> bool:
    return all(port.cardinality is Cardinality.ONE and port.kind in (PointCloud, Poses) for port in spec.ports)


@contextmanager
def _merged_cloud(out: Path) -> Iterator[tuple[PointCloud, Path]]:
    """Yield the cloud in cloud.ply, with its arrays in files, and a folder that is deleted afterwards."""
    with TemporaryDirectory(dir=out, prefix=temporary_prefix(), ignore_cleanup_errors=True) as name:
        with GrowingArrays(Path(name) / "cloud") as grown:
            for part in open_ply_points(out / "cloud.ply").cloud_chunks():
                grown.append({array: getattr(part, array) for array in _ARRAYS})
        arrays: dict[str, Any] = grown.arrays()
        yield PointCloud(**arrays), Path(name)
