"""`pano-mvs report`, `share` and `tour`: rewrite the report of a run, write a page to send, or do all for a walk."""

from __future__ import annotations

import os
import shlex
import sys
import webbrowser
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.markup import escape

from pano_mvs.cli.blocks_command import run_decided
from pano_mvs.cli.console import Console
from pano_mvs.cli.run.printing import is_to_share, print_next
from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import is_file, is_folder, resolved
from pano_mvs.core.text import plural
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.running.output_lock import output_lock
from pano_mvs.io.images.captures import VIDEO_SUFFIXES
from pano_mvs.report import write_report
from pano_mvs.results.run_output import load
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary, cache_of
from pano_mvs.session.captures import is_early
from pano_mvs.session.merging.block_runs import decide_blocks
from pano_mvs.session.running import Execution
from pano_mvs.session.session import default_out, open_session
from pano_mvs.share import ShareOptions, share_run
from pano_mvs.share.page_folder import require_free
from pano_mvs.viewer.shown_scene import is_to_see


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


def share_output(
    out: Path, to: Path, options: ShareOptions, *, images: Path | None, cache: Path | None, console: Console
) -> None:
    """Write the page of an output folder and print where it is."""
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


@dataclass(frozen=True)
class TourWanted:
    """What a tour is made of, and where."""

    images: Path
    out: Path | None = None
    workflow: str = ""
    overrides: tuple[str, ...] = ()
    cache: Path | None = None


def make_tour(wanted: TourWanted, console: Console, *, opens: bool) -> int:
    """Run a workflow, write the page of its results unless it ended early, and return the exit code of the run."""
    is_video = not is_folder(wanted.images) and wanted.images.suffix.lower() in VIDEO_SUFFIXES
    place = resolved(wanted.images)
    session = open_session(
        wanted.workflow or ("walk" if is_video else "mesh"),
        overrides=wanted.overrides,
        images=wanted.images,
        cache=wanted.cache,
        out=wanted.out or default_out(place.stem if is_video else place.name),
    )
    out = session.out if session.out.name.strip(".") else resolved(session.out)
    folder = out.with_name(f"{out.name}_page")
    require_free(folder, "the page would be written to ")
    execution = Execution()
    code = run_decided(session, execution, decide_blocks(session, execution), advise=False)
    if is_early(code):
        console.say("no page is written. To continue, remove the cause and give the same command again")
        return code
    summary = RunSummary.read(session.out)
    if not is_to_share(summary):
        console.say("no page is written, because the run has neither a cloud nor ranges to show")
        return code
    share_output(session.out, folder, ShareOptions(), images=None, cache=session.store_root, console=console)
    page = folder / "index.html"
    if opens and not open_in_browser(page):
        console.say(f"open {escape(str(page))} in a browser")
    print_next([shlex.join(["pano-mvs", "view", str(session.out)])] if is_to_see(summary.files) else [], console)
    return code


def open_in_browser(page: Path, *, environment: Mapping[str, str] = os.environ, platform: str = sys.platform) -> bool:
    """Open a page in a browser with a window, and return whether that was possible."""
    if platform.startswith("linux") and not (environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY")):
        return False  # a browser of the terminal, if there is one, would take this terminal and cannot show the page
    return webbrowser.open(resolved(page).as_uri())
