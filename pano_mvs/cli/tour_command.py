"""`pano-mvs tour`: from a folder of panoramas to a page in the browser."""

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
from pano_mvs.cli.page_commands import share_output
from pano_mvs.cli.run.printing import is_to_share, print_next
from pano_mvs.core.paths import is_folder, resolved
from pano_mvs.io.images.captures import VIDEO_SUFFIXES
from pano_mvs.results.summary import RunSummary
from pano_mvs.session.captures import is_early
from pano_mvs.session.merging.automatic import decide_blocks
from pano_mvs.session.running import Execution
from pano_mvs.session.session import default_out, open_session
from pano_mvs.share import ShareOptions
from pano_mvs.share.page_folder import require_free
from pano_mvs.viewer.shown_scene import is_to_see


@dataclass(frozen=True)
class TourWanted:
    """What a tour is made of, and where.

    Attributes:
        images: folder of panoramas or of a virtual tour, or a video.
        out: output folder; None for `out/` and the name of `images`. The page is beside it.
        workflow: a preset or a workflow file; empty for `mesh`, or `walk` for a video.
        overrides: settings, as `--set` takes them.
        cache: folder of the cache; None for the default.
    """

    images: Path
    out: Path | None = None
    workflow: str = ""
    overrides: tuple[str, ...] = ()
    cache: Path | None = None


def make_tour(wanted: TourWanted, console: Console, *, opens: bool) -> int:
    """Run a workflow, write the page of its results unless it ended early, and return the exit code of the run.

    Args:
        wanted: what the tour is made of.
        console: where to print.
        opens: whether to open the page in a browser.

    Raises:
        UsageError: if the workflow, a setting or a folder cannot be used.
        InputError: if the images cannot be read.
        StoreError: if the cache, the output folder or the page cannot be written.
    """
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
