"""Write the report of a run anew, from what the run left."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import is_file
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.running.output_lock import output_lock
from pano_mvs.report import write_report
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.session.session import CACHE_VARIABLE


def rewrite_report(out: Path, cache: Path | None, console: Console) -> None:
    """Write `report.html` of an output folder from its run.json and the cache that the run used.

    The cache is `cache`, else $PANO_MVS_CACHE, else where run.json says that it was.

    Raises:
        InputError: if there is no run.json, or the cache is not there: a page without pictures would take the place of
            one that has them.
        StoreError: if the cache's book of runs is damaged, or a run is writing into the folder.
    """
    summary = _summary(out / "run.json")
    root = cache or Path(os.environ.get(CACHE_VARIABLE) or str(summary.get("cache") or ".pano-mvs"))
    if not is_file(root / "layout.json"):
        raise InputError(f"there is no cache in {root}, from which the pictures come. Give the one that the run used "
                         "with --cache DIR")  # fmt: skip
    with output_lock(out):
        write_report(out, summary, StoredValues.of_folder(out, summary, Store(root, for_reading=True)))
    console.print(escape(f"{out / 'report.html'} is written"), highlight=False, soft_wrap=True)


def _summary(path: Path) -> dict[str, Any]:
    try:
        summary = json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}). Give the output folder of a run") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is no run.json ({error}). Run again to write it anew") from error
    if not isinstance(summary, dict) or not isinstance(summary.get("stages"), list):
        raise InputError(f"{path} is no run.json. Run again to write it anew")
    return summary
