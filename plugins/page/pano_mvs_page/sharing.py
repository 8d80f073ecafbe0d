"""Write the page of a run and print where it is, or run a workflow first."""

from __future__ import annotations

import os
import shlex
import sys
import webbrowser
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.markup import escape

from pano_mvs.cli.blocks_command import run_capture
from pano_mvs.cli.commands import COMMANDS
from pano_mvs.cli.console import Console
from pano_mvs.cli.run.printing import has_scene, is_to_share, print_next
from pano_mvs.core.errors import InputError, RunStoppedError
from pano_mvs.core.paths import is_folder, resolved
from pano_mvs.core.text import plural
from pano_mvs.io.house_file import HOUSE_FILE
from pano_mvs.results.run_output import load
from pano_mvs.results.summary import RunSummary
from pano_mvs.session.captures import is_early
from pano_mvs.session.session import default_out, open_session
from pano_mvs_page.page_folder import require_free
from pano_mvs_page.scene_parts import ShareOptions
from pano_mvs_page.share import share_run


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
    is_video = not is_folder(wanted.images)
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
    code = run_capture(session)
    is_house = code == RunStoppedError.exit_code and _has_house(session.out)
    if is_early(code) and not is_house:
        console.say("no page is written. To continue, remove the cause and give the same command again")
        return code
    summary = RunSummary.read(session.out)
    if not is_house and not is_to_share(summary):
        console.say("no page is written, because the run has neither a cloud nor ranges to show")
        return code
    share_output(session.out, folder, ShareOptions(), images=None, cache=session.store_root, console=console)
    page = folder / "index.html"
    if opens and not open_in_browser(page):
        console.say(f"open {escape(str(page))} in a browser")
    if has_scene(summary) and "view" in COMMANDS.names():
        print_next([shlex.join(["pano-mvs", "view", str(session.out)])], console)
    return code


def _has_house(out: Path) -> bool:
    """Return whether links made a house of a run that stopped, because matches join no two of its panoramas."""
    try:
        summary = RunSummary.read(out)
    except InputError:
        return False
    return HOUSE_FILE in summary.files and not summary.poses.registered


def open_in_browser(page: Path, *, environment: Mapping[str, str] = os.environ, platform: str = sys.platform) -> bool:
    """Open a page in a browser with a window, and return whether that was possible."""
    if platform.startswith("linux") and not (environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY")):
        return False  # a browser of the terminal, if there is one, would take this terminal and cannot show the page
    return webbrowser.open(resolved(page).as_uri())
