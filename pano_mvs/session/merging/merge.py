"""Merge the output folders of blocks into one output folder, if the blocks agree about their common cameras."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import pano_mvs
from pano_mvs.algorithms.blocks import (
    MIN_COMMON,
    BlockAlignment,
    BlockLink,
    MergedBlocks,
    adjust_merged,
    align_blocks,
    camera_spacing,
    merge_blocks,
)
from pano_mvs.algorithms.poses.verification.belief.doubts import probability_of, with_later_evidence
from pano_mvs.core.errors import ContractError, InputError, StoreError, UsageError
from pano_mvs.core.file_names import PAIR_SEPARATOR
from pano_mvs.core.files import OUTPUT_MARK, clear_abandoned, is_full_disk, remove_whole, temporary_prefix
from pano_mvs.core.paths import children, exists, is_folder, resolved
from pano_mvs.core.text import plural
from pano_mvs.engine.cache.blobs import BlobRef
from pano_mvs.engine.cache.store import ItemRef, Store
from pano_mvs.engine.executors.execute import unit_outcome
from pano_mvs.engine.executors.threads import available_threads
from pano_mvs.engine.planning.unit_keys import single_unit
from pano_mvs.engine.running.output_lock import LOCK_NAME, output_lock
from pano_mvs.engine.running.publish import delivered_files
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage import Cardinality, StageSpec
from pano_mvs.engine.workflows.policy import Policy
from pano_mvs.engine.workflows.workflow import StageEntry
from pano_mvs.io.growing_arrays import GrowingArrays
from pano_mvs.io.house_file import HOUSE_FILE
from pano_mvs.io.images.captures import natural_key
from pano_mvs.io.ply import open_ply_points
from pano_mvs.report.page import gather_report, write_page
from pano_mvs.results.records import (
    CloudSummary,
    ImageReason,
    MergedSummary,
    PairLink,
    StageOutcome,
    ViewSummary,
    WorkflowSummary,
)
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import BLOCKS, FAILED_ITEMS, RunSummary
from pano_mvs.scene import Files, PointCloud, Poses, Record
from pano_mvs.session.merging.files import Block, MergeFiles, load_blocks
from pano_mvs.session.running import min_free_bytes
from pano_mvs.session.summarise import poses_summary

_STAGE = "merge"
_ADJUSTS = "poses.refine"  # without it, blocks have poses that are to be kept
_MERGED_NAMES = {
    *(OUTPUT_MARK, LOCK_NAME, BLOCKS, "cloud.ply", "colmap", "transforms.json", "poses.json"),
    *("range", "confidence", "uncertainty", "preview", "floor_plan", "mesh.ply", "tiles_3d"),
}


@dataclass(frozen=True, eq=False)
class MergeResult:
    """What a merge found and wrote."""

    summary: RunSummary
    blocks: tuple[Block, ...]  # the blocks, as given
    alignment: BlockAlignment  # their similarities and their agreement
    merged: MergedBlocks  # the cameras, and to which block each belongs


def merge_outputs(outs: Sequence[Path], to: Path, *, cache: Path | None = None) -> MergeResult:
    """Merge the output folders of blocks that have cameras in common, and write the result to another folder.

    The folder gets the COLMAP model, transforms.json, poses.json, cloud.ply, range maps with their confidence, what the
    exports of the largest block that read nothing but poses and cloud make of these, run.json and a report. The world
    is that of the largest block whose unit is the metre, or else of the largest block. Nothing is written if the blocks
    are not connected, or disagree.

    Args:
        to: folder to write to: new, empty, or the result of an earlier merge.
        cache: folder of the cache that all runs used; None for those that their run.json name.

    Raises:
        UsageError: if the folders cannot be used.
        InputError: if a run has no poses, blocks are not connected, or disagree about their common cameras.
        StoreError: if a file cannot be written.
    """
    started, clock = datetime.now(UTC), time.perf_counter()
    blocks = load_blocks(outs, cache)
    if resolved(to) in {resolved(out) for out in outs}:
        raise UsageError(f"--out {to}: this is one of the blocks. Choose another folder")
    earlier = require_free(to)
    reference = max(
        range(len(blocks)), key=lambda number: (blocks[number].poses.metric, len(blocks[number].poses.names), -number)
    )
    alignment = align_blocks([block.poses.cameras for block in blocks], reference)
    _require_connected(blocks, alignment)
    _require_agreement(blocks, alignment)
    similarities = [similarity for similarity in alignment.world_from_block if similarity is not None]
    order = sorted({name for block in blocks for name in block.poses.names}, key=natural_key)
    merged = merge_blocks([block.poses for block in blocks], similarities, order=order, reference=reference)
    if all(any(stage.use == _ADJUSTS for stage in block.run.summary.stages) for block in blocks):
        merged = adjust_merged(merged)
    merged = replace(merged, poses=with_later_evidence(merged.poses, evidence_of_blocks(blocks, alignment)))
    to.mkdir(parents=True, exist_ok=True)
    (to / OUTPUT_MARK).touch()
    with output_lock(to):
        clear_abandoned(to)
        files = MergeFiles(to, blocks, similarities, merged)
        summary = _written(files, alignment, exports_of=blocks[reference].run.summary)
        files.remove_stale(earlier)
        summary = summary.model_copy(
            update={
                "started": started.isoformat(timespec="seconds"),
                "seconds": round(time.perf_counter() - clock, 3),
            }
        )
        report = gather_report(to, summary, StoredValues())
        summary = summary.model_copy(update={"verdict": report.verdict})
        summary.write(to)
        write_page(to, summary, report)
    return MergeResult(summary, tuple(blocks), alignment, merged)


def require_free(to: Path) -> RunSummary:
    """Check that merged results may be written to a folder, and return what an earlier merge states about them.

    Raises:
        UsageError: if it is not a folder, or holds anything but the result of an earlier merge and its blocks.
    """
    if not exists(to):
        return RunSummary()
    if not is_folder(to):
        raise UsageError(f"--out {to}: this is not a folder. Choose another one")
    names = {path.name for path in children(to) if not path.name.startswith(".tmp-")}
    # Without run.json, these are of a merge that was interrupted.
    if names <= {OUTPUT_MARK, LOCK_NAME, BLOCKS} or (OUTPUT_MARK in names and names <= _MERGED_NAMES):
        return RunSummary()
    try:
        earlier = RunSummary.read(to)
    except InputError:
        earlier = RunSummary()
    if earlier.merged is None and earlier.workflow.name != _STAGE:
        raise UsageError(f"--out {to}: the folder holds something else. Choose a new or an empty one")
    return earlier


def _written(files: MergeFiles, alignment: BlockAlignment, *, exports_of: RunSummary) -> RunSummary:
    """Write all files except run.json and the report, and return the summary."""
    blocks, poses = files.blocks, files.merged.poses
    points = files.write_cloud()
    files.write_model(has_cloud=points > 0)
    views = files.write_ranges()
    exported, left_out = _repeat_exports(files, exports_of, has_cloud=points > 0)
    notes = (*_notes(blocks, alignment), *_adjustment_notes(files.merged), *left_out)
    doubts = {name: ImageReason(stage=_STAGE, reason=why) for name, why in poses.doubts.items()}
    rejected = _rejected(blocks, poses)
    warnings = (
        *[
            f"{blocks[link.first].name} and {blocks[link.second].name} agree less than usual: {link_text(link)}"
            for link in alignment.links
            if is_doubtful(link)
        ],
        *_failures(blocks, rejected),
    )
    return RunSummary(
        workflow=WorkflowSummary(name=_STAGE),
        merged=MergedSummary(blocks=tuple(str(resolved(block.run.out)) for block in blocks), images=_images(blocks)),
        version=pano_mvs.__version__,
        exit_code=FAILED_ITEMS if doubts or rejected or warnings else 0,
        rejected={name: ImageReason(stage=_STAGE, reason=why) for name, why in rejected.items()},
        doubts=doubts,
        warnings=warnings,
        notes=notes,
        poses=poses_summary(poses, rejected=rejected, doubts=poses.doubts, links=_links(blocks)),
        views=tuple[ViewSummary, ...](views),
        cloud=CloudSummary(points=points or None),
        files=exported,
        versions=dict(max((block.run.summary for block in blocks), key=lambda summary: summary.started).versions),
    )


def _rejected(blocks: Sequence[Block], poses: Poses) -> dict[str, str]:
    """Return the images without a pose in the result, with the reason, in the order of the capture."""
    found, registered = dict(poses.rejected), {*poses.names}
    for block in blocks:
        why = dict.fromkeys(block.left_out, f"it is in a smaller group of the poses of {block.name}")
        why |= {
            unit.item: unit.cause
            for unit in block.run.summary.failures
            if unit.item and PAIR_SEPARATOR not in unit.item
        }
        found |= {name: reason for name, reason in why.items() if name not in registered and name not in found}
    return dict(sorted(found.items(), key=lambda item: natural_key(item[0])))


def _failures(blocks: Sequence[Block], rejected: Mapping[str, str]) -> list[str]:
    """Return what failed in each block, apart from images without a pose."""
    found = []
    for block in blocks:
        failed = [unit for unit in block.run.summary.failures if unit.item not in rejected]
        if failed:
            first = failed[0]
            unit = f"{first.stage}:{first.item}" if first.item else first.stage
            found.append(
                f"{block.name}: {len(failed)} {plural(len(failed), 'unit')} failed, such as {unit}: {first.cause}"
            )
    return found


def _images(blocks: Sequence[Block]) -> str:
    """Return the folder in which all images are, or to which the blocks are links; "" if there is no such folder."""
    folders = set()
    for block in blocks:
        source = block.run.summary.source_folder
        for name in block.poses.names:
            path = resolved(source / name) if source is not None else Path()
            folders.add(
                path.parents[len(PurePosixPath(name).parts) - 1] if path.as_posix().endswith(f"/{name}") else None
            )
    found = folders.pop() if len(folders) == 1 else None
    return "" if found is None else str(found)


def _notes(blocks: Sequence[Block], alignment: BlockAlignment) -> tuple[str, ...]:
    notes = [
        f"{blocks[link.first].name} and {blocks[link.second].name}: {len(link.names)} common cameras; {link_text(link)}"
        for link in alignment.links
    ]
    for block in blocks:
        if count := len(block.left_out):
            notes.append(
                f"{block.name}: {count} {plural(count, 'camera')} in smaller groups of its poses "
                f"{plural(count, 'is', 'are')} not merged"
            )
    return (*notes, *scale_notes(blocks, alignment))


def _adjustment_notes(merged: MergedBlocks) -> list[str]:
    if merged.before is None:
        return []
    moved = np.linalg.norm(merged.poses.centers - merged.before.centers, axis=1) / camera_spacing(merged.before.centers)
    return [
        f"all {len(moved)} cameras were adjusted together; they moved by {_small(100 * float(np.median(moved)))} % of "
        f"the distance between neighbouring cameras in the median, and by {_small(100 * float(moved.max()))} % at most"
    ]


def _links(blocks: Sequence[Block]) -> tuple[PairLink, ...]:
    """Return the matched pairs of all blocks, each once."""
    found: dict[tuple[str, str], PairLink] = {}
    for block in blocks:
        for link in block.run.summary.poses.links:
            found.setdefault((link.first, link.second), link)
    return tuple(found.values())


# As shares of the distance between neighbouring cameras, and in degrees: medians over the common cameras of two blocks.
DOUBTFUL_OFFSET, REFUSED_OFFSET = 0.05, 0.25
DOUBTFUL_TURN_DEG, REFUSED_TURN_DEG = 0.5, 3.0


def _require_connected(blocks: Sequence[Block], alignment: BlockAlignment) -> None:
    """Check that all blocks are connected by common cameras."""
    lost = [number for number, similarity in enumerate(alignment.world_from_block) if similarity is None]
    if not lost:
        return
    number = lost[0]
    own = set(blocks[number].poses.names)
    common = {other: len(own & set(block.poses.names)) for other, block in enumerate(blocks) if other != number}
    best = max(common, key=lambda other: (common[other], -other))
    few = common[best] < MIN_COMMON
    raise InputError(
        f"{blocks[number].name}: "
        + (
            f"shares {common[best]} registered {plural(common[best], 'camera')} with {blocks[best].name}, and fewer "
            f"with the other blocks; {MIN_COMMON} are needed, and 20 or more are better. "
            if few
            else f"shares cameras only with blocks such as {blocks[best].name} that are not connected to the others. "
        )
        + "Let blocks overlap by images that see each other, with the same names in all blocks"
    )


def _require_agreement(blocks: Sequence[Block], alignment: BlockAlignment) -> None:
    """Check that the common cameras of all pairs of blocks agree at least roughly."""
    bad = [
        link for link in alignment.links if link.relative_offset > REFUSED_OFFSET or link.turn_deg > REFUSED_TURN_DEG
    ]
    if bad:
        worst = max(bad, key=lambda link: (link.relative_offset, link.turn_deg))
        raise InputError(
            f"{blocks[worst.first].name} and {blocks[worst.second].name} disagree about their "
            f"{len(worst.names)} common cameras: {link_text(worst)}. One of the models is wrong, or images of the same "
            "name differ. Look at the reports of both"
        )


def link_text(link: BlockLink) -> str:
    """Return the agreement of two blocks in words."""
    return (
        f"positions differ by {_small(100 * link.relative_offset)} % of the distance between neighbouring cameras, "
        f"orientations by {_small(link.turn_deg)}° (medians)"
    )


def _small(value: float) -> str:
    return f"{value:.2g}" if value >= 0.001 else "less than 0.001"


def is_doubtful(link: BlockLink) -> bool:
    """Return whether two blocks agree less than usual."""
    return link.relative_offset > DOUBTFUL_OFFSET or link.turn_deg > DOUBTFUL_TURN_DEG


def evidence_of_blocks(blocks: Sequence[Block], alignment: BlockAlignment) -> dict[str, tuple[float, str]]:
    """Return the common cameras that two blocks place differently, with a likelihood ratio and what it rests on.

    At most one of two different poses is right: if that of one block is, the other one is wrong. Which of the two is
    used is not known here, so that the more probable one speaks against it.
    """
    found: dict[str, tuple[float, str]] = {}
    for link in alignment.links:
        known = [probability_of(blocks[number].poses) for number in (link.first, link.second)]
        for name, offset in zip(link.names, link.offsets.tolist(), strict=True):
            if offset > 0.5 * link.spacing:  # the distance between neighbouring cameras
                found[name] = (
                    1 - max(probabilities[name] for probabilities in known),
                    f"{blocks[link.first].name} and {blocks[link.second].name} place it "
                    f"{offset / link.spacing:.2g} times the distance between neighbouring cameras apart",
                )
    return found


def scale_notes(blocks: Sequence[Block], alignment: BlockAlignment) -> list[str]:
    """Return notes on blocks that state metres but are of different size."""
    notes = []
    reference = blocks[alignment.reference]
    for block, similarity in zip(blocks, alignment.world_from_block, strict=True):
        assert similarity is not None
        if reference.poses.metric and block.poses.metric and abs(similarity.scale - 1) > 0.02:
            notes.append(
                f"{block.name} and {reference.name} both state metres, but differ in scale by "
                f"{100 * abs(similarity.scale - 1):.2g} %. The metres of {reference.name} are used"
            )
    return notes


_MERGED = {"export.colmap", "export.ply", "export.ranges", "export.previews", "export.nerfstudio"}
_ARRAYS = ("points_in_world", "normals_in_world", "colors_rgb", "view_counts", "confidence", "uncertainty")


def _repeat_exports(files: MergeFiles, block: RunSummary, *, has_cloud: bool) -> tuple[dict[str, str], list[str]]:
    """Write what the exports of a block make of the merged poses and cloud.ply; return file to digest, and notes.

    Exports of plugins are not repeated. An export that fails loses nothing else.

    Args:
        files: whose model and cloud have been written.
        block: the run whose exports and settings are taken.
        has_cloud: whether cloud.ply has points.
    """
    stages = Registry.installed().stages
    found = [(outcome, stages[outcome.use]) for outcome in block.stages if outcome.use in stages]
    exports = [(outcome, spec) for outcome, spec in found if spec.output is Files and spec.name not in _MERGED]
    repeated = [(outcome, spec) for outcome, spec in exports if _is_repeated(spec)]
    written: dict[str, str] = {}
    # Blocks of anything but a tour have no house.
    absent = {"export.house"} - ({"export.house"} if HOUSE_FILE in block.files else set())
    left_out = dict.fromkeys(spec.name for _, spec in exports if not _is_repeated(spec) and spec.name not in absent)
    notes = [f"of each block, and not merged: the files of {', '.join(left_out)}"] if left_out else []
    if not repeated or not has_cloud:
        return written, notes
    try:
        with _merged_inputs(files) as (store, inputs):
            for outcome, spec in repeated:
                try:
                    made, told = _export(outcome, spec, inputs, store=store)
                    notes += told
                    if clashes := [target for target in made if target in written]:
                        raise InputError(f"another export has written {clashes[0]}")
                    for target, blob in made.items():
                        store.blobs.copy(blob, files.to_write(target))
                        written[target] = blob.digest
                except Exception as error:  # also of a library
                    if is_full_disk(error) or is_full_disk(error.__cause__):
                        raise _cannot_write(files.out, error) from error
                    notes.append(f"{spec.name} was not repeated for the merged capture: {error}")
    except ContractError as error:
        notes.append(f"no export was repeated for the merged capture: {error}")
    return written, notes


def _is_repeated(spec: StageSpec) -> bool:
    """Return whether an export is built in and needs nothing but the cloud and the poses."""
    needed = [port for port in spec.ports if not port.optional or port.kind in (PointCloud, Poses)]
    return spec.is_built_in and all(
        port.cardinality is Cardinality.ONE and port.kind in (PointCloud, Poses) for port in needed
    )


def _export(
    outcome: StageOutcome, spec: StageSpec, inputs: Mapping[type[Record], ItemRef], *, store: Store
) -> tuple[dict[str, BlobRef], list[str]]:
    """Return the stored files of an export by target, and its notes, computed as a unit of a run."""
    entry = StageEntry(outcome.name, spec, spec.params_type.model_validate(outcome.params), Policy(use=spec.name), "")
    unit = single_unit(entry, {port.name: inputs.get(port.kind) for port in spec.ports}, store)
    ended = unit_outcome(unit, store, threads=available_threads(), log=store.blobs.temporary / f"{unit.key}.txt")
    if ended.error == "StoreError":
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    if ended.record is None:
        raise InputError(ended.cause)
    notes = [f"{spec.name}: {note}" for note in ended.record.notes]
    return dict(delivered_files(ended.record.output, store)), notes


@contextmanager
def _merged_inputs(files: MergeFiles) -> Iterator[tuple[Store, dict[type[Record], ItemRef]]]:
    """Yield a cache that is deleted afterwards, and in it the merged poses and the cloud in cloud.ply.

    Points of blocks that do not state how many views agree on them count as confirmed.
    """
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(
                TemporaryDirectory(dir=files.out, prefix=temporary_prefix(), ignore_cleanup_errors=True)
            )
            store = Store(Path(folder) / "cache", min_free_bytes=min_free_bytes())
            with GrowingArrays(Path(folder) / "cloud") as grown:
                for part in open_ply_points(files.out / "cloud.ply").cloud_chunks():
                    grown.append({array: getattr(part, array) for array in _ARRAYS})
            arrays: dict[str, Any] = grown.arrays()
            unknown = arrays["view_counts"] == 0
            for array in ("view_counts", "confidence"):
                arrays[array][unknown] = 255
            if not np.isfinite(arrays.get("uncertainty", np.nan)).all():  # a block does not state it
                arrays["uncertainty"] = None
            inputs: dict[type[Record], ItemRef] = {
                PointCloud: store.put_value(PointCloud(**arrays)),
                Poses: store.put_value(files.merged.poses),
            }
            del arrays
            remove_whole(Path(folder) / "cloud")
        except OSError as error:
            raise _cannot_write(files.out, error) from error
        yield store, inputs


def _cannot_write(out: Path, error: BaseException) -> StoreError:
    return StoreError(
        f"{out}: exports of the merged capture cannot be written: {error}. Free some space, and merge again"
    )
