"""Divide a capture into blocks, and merge them."""

from __future__ import annotations

import shlex
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from pano_mvs.core.text import plural
from pano_mvs.session.merging.block_runs import Division, split_images
from pano_mvs.session.merging.merge import merge_outputs


def split_command(images: Path, to: Path, division: Division, *, console: Console) -> None:
    """Write the blocks of a capture, and print them and the commands that follow.

    Raises:
        UsageError: if a setting or a folder cannot be used.
        InputError: if there are no images, or the poses are of other images.
        StoreError: if a link cannot be made.
    """
    blocks = split_images(images, to, division)
    outs = [f"out/{block.folder.name}" for block in blocks]
    for block, out in zip(blocks, outs, strict=True):
        console.print(
            f"{escape(str(block.folder))}: {len(block.names)} images\n"
            f"  pano-mvs run WORKFLOW --images {escape(shlex.quote(str(block.folder)))} --out {out}",
            highlight=False,
            soft_wrap=True,
        )
    console.print(f"then: pano-mvs merge {' '.join(outs)} --out out/merged", highlight=False, soft_wrap=True)


def merge_blocks_command(outs: tuple[Path, ...], to: Path, *, cache: Path | None, console: Console) -> int:
    """Merge output folders, print how well they agree and what was written, and return the exit code.

    Raises:
        UsageError: if the folders cannot be used.
        InputError: if the blocks cannot be merged.
        StoreError: if a file cannot be written.
    """
    with console.status("merging"):
        summary = merge_outputs(outs, to, cache=cache).summary
    for text in summary.notes:
        console.print(escape(text), highlight=False, soft_wrap=True)
    for text in summary.warnings:
        console.print(f"warning: {escape(text)}", highlight=False, soft_wrap=True)
    if count := len(summary.rejected):
        name, why = next(iter(summary.rejected.items()))
        text = f"{count} {plural(count, 'image')} without a pose, such as {name}: {why.reason}"
        console.print(escape(text), highlight=False, soft_wrap=True)
    points = f", cloud of {summary.cloud.points:,} points" if summary.cloud.points else ""
    console.print(
        f"{len(summary.poses.registered)} cameras, {summary.poses.points:,} sparse points, {len(summary.views)} range "
        f"maps{points}\nreport: {escape(str(to / 'report.html'))}\n"
        f"next:\n  {escape(shlex.join(['pano-mvs', 'view', str(to)]))}",
        highlight=False,
        soft_wrap=True,
    )
    return summary.exit_code
