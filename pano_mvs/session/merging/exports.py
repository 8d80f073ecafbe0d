"""Repeat the exports of a block for the merged capture: those that read nothing but the cloud and the poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pano_mvs.core.digest import digest_from_file
from pano_mvs.core.errors import InputError, StoreError
from pano_mvs.core.files import copy_file, is_full_disk, temporary_prefix
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

    Exports of plugins are not repeated. An export that fails loses nothing else.

    Args:
        files: whose model and cloud have been written.
        block: the run whose exports and settings are taken.
        has_cloud: whether cloud.ply has points.

    Raises:
        StoreError: if the disk is full, or the cloud cannot be copied into arrays of its own.
    """
    stages = Registry.installed().stages
    found = [(outcome, stages[outcome.use]) for outcome in block.stages if outcome.use in stages]
    exports = [(outcome, spec) for outcome, spec in found if spec.output is Files and spec.name not in _MERGED]
    repeated = [(outcome, spec) for outcome, spec in exports if _is_repeated(spec)]
    written: dict[str, str] = {}
    left_out = dict.fromkeys(spec.name for _, spec in exports if not _is_repeated(spec))
    notes = [f"of each block, and not merged: the files of {', '.join(left_out)}"] if left_out else []
    if not repeated or not has_cloud:
        return written, notes
    with _merged_cloud(files.out) as (cloud, scratch):
        for number, (outcome, spec) in enumerate(repeated):
            ctx = Context(np.random.default_rng(0), scratch / f"export_{number}")
            try:
                ctx.scratch.mkdir()
                made = _export(spec, outcome.params, (cloud, files.merged.poses), ctx=ctx)
                if clashes := [target for target in made.files if target in written]:
                    raise InputError(f"another export has written {clashes[0]}")
                for target, path in made.files.items():
                    copy_file(path, files.to_write(target))
                    written[target] = digest_from_file(path)
            except Exception as error:  # also of a library
                if is_full_disk(error) or is_full_disk(error.__cause__):
                    raise _cannot_write(files.out, error) from error
                notes.append(f"{spec.name} was not repeated for the merged capture: {error}")
            notes += [f"{spec.name}: {note}" for note in ctx.notes]
    return written, notes


def _is_repeated(spec: StageSpec) -> bool:
    """Return whether an export is one of this package and reads nothing but the cloud and the poses."""
    is_own = spec.function.__module__.startswith("pano_mvs.stages.")
    return is_own and all(
        port.cardinality is Cardinality.ONE and port.kind in (PointCloud, Poses) for port in spec.ports
    )


def _export(spec: StageSpec, params: Mapping[str, object], merged: tuple[PointCloud, Poses], *, ctx: Context) -> Files:
    extras = {"params": spec.params_type.model_validate(params), "ctx": ctx}
    cloud, poses = merged
    inputs: dict[str, object] = {port.name: cloud if port.kind is PointCloud else poses for port in spec.ports}
    made = spec.function(**inputs, **{name: extras[role] for name, role in spec.extras.items()})
    assert isinstance(made, Files)
    made.check()
    return made


@contextmanager
def _merged_cloud(out: Path) -> Iterator[tuple[PointCloud, Path]]:
    """Yield the cloud in cloud.ply, with its arrays in files, and a folder that is deleted afterwards.

    Points of blocks that do not state how many views agree on them count as confirmed.

    Raises:
        StoreError: if the arrays cannot be written.
    """
    with ExitStack() as stack:
        try:
            name = stack.enter_context(
                TemporaryDirectory(dir=out, prefix=temporary_prefix(), ignore_cleanup_errors=True)
            )
            with GrowingArrays(Path(name) / "cloud") as grown:
                for part in open_ply_points(out / "cloud.ply").cloud_chunks():
                    grown.append({array: getattr(part, array) for array in _ARRAYS})
        except OSError as error:
            raise _cannot_write(out, error) from error
        arrays: dict[str, Any] = grown.arrays()
        unknown = arrays["view_counts"] == 0
        for array in ("view_counts", "confidence"):
            arrays[array][unknown] = 255
        yield PointCloud(**arrays), Path(name)


def _cannot_write(out: Path, error: BaseException) -> StoreError:
    return StoreError(
        f"{out}: exports of the merged capture cannot be written: {error}. Free some space, and merge again"
    )
