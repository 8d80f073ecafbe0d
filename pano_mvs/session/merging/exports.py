"""Repeat the exports of a block for the merged capture: those that read nothing but the cloud and the poses."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pydantic import ValidationError

from pano_mvs.core.digest import digest_from_file
from pano_mvs.core.errors import PanoMvsError
from pano_mvs.core.files import copy_file, temporary_prefix
from pano_mvs.core.paths import is_file
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


def repeat_exports(files: MergeFiles, block: RunSummary) -> tuple[dict[str, str], list[str]]:
    """Write what the exports of a block make of the merged poses and cloud.ply; return file to digest, and notes.

    Args:
        files: whose model and cloud have been written.
        block: the run whose exports and settings are taken.

    Raises:
        StoreError: if a file cannot be written.
    """
    stages = Registry.installed().stages
    written: dict[str, str] = {}
    notes: list[str] = []
    missing: list[str] = []
    with _merged_cloud(files.out) as (cloud, scratch):
        for outcome in block.stages:
            spec = stages.get(outcome.use)
            if spec is None or spec.output is not Files or spec.name in _MERGED:
                continue
            if cloud is None or not _reads_only(spec):
                missing.append(outcome.use)
                continue
            ctx = Context(np.random.default_rng(0), scratch / outcome.name)
            ctx.scratch.mkdir()
            inputs = {port.name: cloud if port.kind is PointCloud else files.merged.poses for port in spec.ports}
            try:
                params = spec.params_type.model_validate(outcome.params)
                made = spec.function(**inputs, params=params, ctx=ctx)
            except (PanoMvsError, ValidationError) as error:
                notes.append(f"{outcome.use} was not repeated for the merged capture: {error}")
                continue
            assert isinstance(made, Files)
            for target, path in made.files.items():
                copy_file(path, files.to_write(target))
                written[target] = digest_from_file(path)
            notes += [f"{outcome.use}: {note}" for note in ctx.notes]
    if missing:
        notes.append(f"of each block, and not merged: the files of {', '.join(dict.fromkeys(missing))}")
    return written, notes


def _reads_only(spec: StageSpec) -> bool:
    return all(port.cardinality is Cardinality.ONE and port.kind in (PointCloud, Poses) for port in spec.ports)


@contextmanager
def _merged_cloud(out: Path) -> Iterator[tuple[PointCloud | None, Path]]:
    """Yield the cloud in cloud.ply, with its arrays in files, and a folder that is deleted afterwards."""
    with TemporaryDirectory(dir=out, prefix=temporary_prefix()) as name:
        folder = Path(name)
        if not is_file(out / "cloud.ply"):
            yield None, folder
            return
        with GrowingArrays(folder / "cloud") as grown:
            for part in open_ply_points(out / "cloud.ply").cloud_chunks():
                grown.append({array: getattr(part, array) for array in _ARRAYS})
        arrays = grown.arrays()
        yield (PointCloud(**arrays) if arrays else None), folder
