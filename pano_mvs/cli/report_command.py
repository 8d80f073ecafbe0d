"""`pano-mvs report`: rewrite the report of a run."""

from __future__ import annotations

from pathlib import Path

from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import is_file
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.running.output_lock import output_lock
from pano_mvs.report import write_report
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary, cache_of


def rewrite_report(out: Path, cache: Path | None, console: Console) -> None:
    """Write `report.html` of an output folder from its run.json and the cache that the run used.

    The cache is `cache`, else $PANO_MVS_CACHE, else the one that run.json names. Merged runs need none.
    """
    summary, values = RunSummary.read(out), StoredValues()
    if summary.merged is None:  # merged runs have no values in a cache: their pictures are files in the folder
        root = cache_of(summary, cache)
        if not is_file(root / "layout.json"):
            raise InputError(
                f"there is no cache in {root}, from which the pictures come. Give the one that the run used "
                "with --cache DIR"
            )
        values = StoredValues.of_folder(out, summary, Store(root, for_reading=True))
    with output_lock(out):
        write_report(out, summary, values)
    console.say(escape(f"{out / 'report.html'} is written"))
