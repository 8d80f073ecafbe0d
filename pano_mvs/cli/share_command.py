"""Write a run as a page to send."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.markup import escape

from pano_mvs.core.text import plural
from pano_mvs.results.run_output import load
from pano_mvs.share import ShareOptions, share_run


def share_output(
    out: Path, to: Path, options: ShareOptions, *, images: Path | None, cache: Path | None, console: Console
) -> None:
    """Write the page of an output folder and print where it is.

    Raises:
        InputError: if the folder holds no run, or the run has nothing to show.
        UsageError: if `to` holds something else.
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
        console.print(f"note: {escape(note)}", highlight=False, soft_wrap=True)
    surface = f", {shared.triangles:,} {plural(shared.triangles, 'triangle')}" if shared.triangles else ""
    console.print(
        f"{shared.points:,} {plural(shared.points, 'point')}{surface} and {shared.panoramas} "
        f"{plural(shared.panoramas, 'panorama')}, {shared.total_bytes / 1e6:.1f} MB\n"
        f"page: {escape(str(shared.page))} (send or upload the whole folder)",
        highlight=False,
        soft_wrap=True,
    )
    if shared.single_file is not None:
        console.print(f"one file: {escape(str(shared.single_file))}", highlight=False, soft_wrap=True)
