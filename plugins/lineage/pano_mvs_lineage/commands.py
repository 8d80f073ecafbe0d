"""`pano-mvs runs`, `diff` and `why`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.console import Console, print_json
from pano_mvs.cli.endings import guarded
from pano_mvs.cli.options import CacheOption

_MOST_SETTINGS = 6  # in a table on the terminal
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


@guarded
def runs(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[FOLDER]...", help="Output folders, or folders of these; default: out."),
    ] = None,
    metrics: Annotated[
        list[str] | None,
        typer.Option("--metric", metavar="STAGE.METRIC", help="Metric to list; can be repeated. Default: scores."),
    ] = None,
    sort: Annotated[
        str,
        typer.Option(
            "--sort", metavar="COLUMN", help="Column to sort by, -COLUMN for the largest first.", show_default=False
        ),
    ] = "",
    csv: Annotated[Path | None, typer.Option("--csv", metavar="FILE", help="CSV file to write.")] = None,
    as_json: JsonOption = False,
) -> None:
    """List runs: the settings in which they differ, chosen metrics, scores, and how each ended."""
    from pano_mvs.core.files import write_given
    from pano_mvs_lineage.runs import runs as list_runs

    table = list_runs(folders or ["out"], metrics=metrics or [], sort=sort)
    if csv is not None:
        write_given(csv, table.to_csv(), f"--csv {csv}")
    if as_json:
        print_json(table.to_json())
        return
    console = Console()
    hidden = max(0, len(table.settings) - _MOST_SETTINGS)
    first = len(table.headings) - len(table.metrics) - hidden
    columns = [*range(first), *range(first + hidden, len(table.headings))]
    shown = Table(*(escape(table.headings[column]) for column in columns))
    for row in table.rows:
        cells = table.cells(row)
        shown.add_row(*(escape(cells[column]) for column in columns))
    console.show(shown)
    if hidden:
        console.say(f"settings that differ and are not shown: {hidden}; --csv FILE and --json list them")
    for note in table.notes:
        console.say(f"note: {escape(note)}")
    for why_not in table.skipped:
        console.say(f"left out: {escape(why_not)}")


@guarded
def diff(
    before: Annotated[Path, typer.Argument(metavar="RUN", help="The output folder of a run.")],
    after: Annotated[Path, typer.Argument(metavar="RUN", help="That of the other run.")],
    page: Annotated[
        Path | None,
        typer.Option("--page", metavar="FILE.html", help="Write a page with the views of both side by side."),
    ] = None,
    cache: CacheOption = None,
    as_json: JsonOption = False,
) -> None:
    """Say what differs between two runs, and why: settings, code, images, metrics, poses, ranges, files, verdict."""
    from pano_mvs.core.files import write_given
    from pano_mvs_lineage.diff import diff as compare
    from pano_mvs_lineage.page import diff_page

    found = compare(before, after, cache=cache)
    if page is not None:
        write_given(page, diff_page(found, cache=cache), f"--page {page}")
    if as_json:
        print_json(found.to_json())
        return
    console = Console()
    for part in found.parts():
        for line in [f"{part.title}:"] if part.rows else part.text if part.lines else [part.title]:
            console.say(escape(line))
        if part.rows:
            shown = Table(*map(escape, part.columns))
            for row in part.rows:
                shown.add_row(*map(escape, row))
            console.show(shown)
    if page is not None:
        console.say(f"page: {escape(str(page))}")


@guarded
def why(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A file that a run has written, also a copy of it.")],
    folders: Annotated[
        list[Path] | None,
        typer.Option("--runs", metavar="DIR", help="Where to look for the run of a copied file; can be repeated."),
    ] = None,
    again: Annotated[
        bool, typer.Option("--again", help="Compute the unit that made the file again, and compare its bytes.")
    ] = False,
    cache: CacheOption = None,
    as_json: JsonOption = False,
) -> None:
    """Say where a file comes from: its run, the unit that made it, settings, code, and all inputs up to the images."""
    from pano_mvs_lineage.why import repeat
    from pano_mvs_lineage.why import why as origin_of

    origin, console = origin_of(file, runs=folders or [], cache=cache), Console()
    repeated = repeat(origin, cache=cache) if again else None
    if as_json:
        found = {} if repeated is None else {"again": {"same": repeated.is_same, "seconds": repeated.seconds}}
        print_json(origin.to_json() | found)
    else:
        for line in origin.lines():
            console.say(escape(line))
        if repeated is not None:
            same = "the same bytes" if repeated.is_same else "other bytes"
            console.say(f"computed again in {repeated.seconds:.2f} s: {same}")
    if repeated is not None and not repeated.is_same:
        raise typer.Exit(4)
