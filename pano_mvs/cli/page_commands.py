"""`pano-mvs report` and `share`: rewrite the report of a run, or write it as a page to send."""

from __future__ import annotations

from pathlib import Path

from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import is_file
from pano_mvs.core.text import plural
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.running.output_lock import output_lock
from pano_mvs.report import write_report
from pano_mvs.results.run_output import load
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary, cache_of
from pano_mvs.share import ShareOptions, share_run


def rewrite_report(out: Path, cache: Path | None, console: Console) -> None:
    """Write `report.html` of an output folder from its run.json and the cache that the run used.

    The cache is `cache`, else $PANO_MVS_CACHE, else the one that run.json names. Merged runs need none.

    Raises:
        InputError: if there is no run.json or no cache, since a page without images would replace one with images.
        StoreError: if the cache's list of runs is damaged, or a run is writing into the folder.
    """
    summary = RunSummary.read(out)
    # Merged runs have no values in a cache: their pictures are files in the folder.
    values = StoredValues() if summary.merged is not None else _stored_values(out, summary, cache)
    with output_lock(out):
        write_report(out, summary, values)
    console.say(escape(f"{out / 'report.html'} is written"))


def _stored_values(out: Path, summary: RunSummary, cache: Path | None) -> StoredValues:
    root = cache_of(summary, cache)
    if not is_file(root / "layout.json"):
        raise InputError(
            f"there is no cache in {root}, from which the pictures come. Give the one that the run used "
            "with --cache DIR"
        )
    return StoredValues.of_folder(out, summary, Store(root, for_reading=True))


def share_output(
    out: Path, to: Path, options: ShareOptions, *, images: Path | None, cache: Path | None, console: Console
) -> None:
    """Write the page of an output folder and print where it is.

    Raises:
        InputError: if the folder holds no run, or the run has nothing to show.
        UsageError: if `to` holds something else, or cannot be written.
        StoreError: if a file cannot be written.
    """
    with console.status("panoramas") as status:
        shared = share_run(
            load(out, cache=cache),
            to,
            options,
            images=images,
            progress=lambda done, total: status.update(f"panoramas {done}/{total}"),
        )
    for note in shared.notes:
        console.say(f"note: {escape(note)}")
    surface = f", {shared.triangles:,} {plural(shared.triangles, 'triangle')}" if shared.triangles else ""
    console.say(
        f"{shared.points:,} {plural(shared.points, 'point')}{surface} and {shared.panoramas} "
        f"{plural(shared.panoramas, 'panorama')}, {shared.total_bytes / 1e6:.1f} MB\n"
        f"page: {escape(str(shared.page))} (send or upload the whole folder)"
    )
    if shared.single_file is not None:
        console.say(f"one file: {escape(str(shared.single_file))}")
