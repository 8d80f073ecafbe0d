"""`pano-mvs cache`: size, content and integrity of a cache, and results that can be deleted."""

from __future__ import annotations

import os
import re
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.commands import PluginGroup
from pano_mvs.cli.console import Console
from pano_mvs.cli.endings import guarded
from pano_mvs.cli.options import CacheOption
from pano_mvs.core.errors import UsageError
from pano_mvs.core.memory import size_text
from pano_mvs.core.paths import is_denied, is_file
from pano_mvs.core.text import plural

if TYPE_CHECKING:  # a command loads what it needs itself
    from pano_mvs.engine.cache.store import Store

cache_app = typer.Typer(
    cls=PluginGroup,
    help="Inspect and clean the cache. Only `gc --delete` and `verify` delete files.",
    no_args_is_help=True,
)


def cache_root(cache: Path | None) -> Path:
    """Return the folder given by `--cache`, $PANO_MVS_CACHE, or `.pano-mvs` in the current folder."""
    from pano_mvs.results.summary import CACHE_VARIABLE

    return cache or Path(os.environ.get(CACHE_VARIABLE) or ".pano-mvs")


def open_cache(cache: Path | None) -> Store:
    """Open the cache given by `--cache`, $PANO_MVS_CACHE, or `.pano-mvs` in the current folder."""
    from pano_mvs.engine.cache.store import Store

    root = cache_root(cache)
    if not is_file(root / "layout.json"):
        if is_denied(root / "layout.json"):
            raise UsageError(f"{root}: this folder cannot be listed (permission denied). Correct its permissions")
        raise UsageError(
            f"{root} is not a cache of pano-mvs; specify one with --cache DIR (it lies beside the workflow file "
            "as .pano-mvs, or where you ran a preset by its name)"
        )
    return Store(root)


@cache_app.command("du")
@guarded
def usage(cache: CacheOption = None) -> None:
    """Show the disk space used by each stage."""
    from pano_mvs.engine.cache.maintenance import size_on_disk, usage_of

    store, console = open_cache(cache), Console()
    table = Table("stage", "units", "size", "computed in")
    for found in usage_of(store):
        table.add_row(found.stage, str(found.units), size_text(found.size_bytes), f"{found.seconds:.0f} s")
    console.print(table)
    console.print(f"{escape(str(store.root))}: {size_text(size_on_disk(store))} on the disk", highlight=False)


@cache_app.command("ls")
@guarded
def runs(cache: CacheOption = None) -> None:
    """List the runs and pins whose results are kept."""
    table = Table("run", "workflow", "ended", "units", "results in")
    for entry in open_cache(cache).runs.entries():
        when = datetime.fromisoformat(entry.when).astimezone().strftime("%Y-%m-%d %H:%M")
        name = f"{entry.name} (pin)" if entry.pinned else entry.name
        table.add_row(escape(name), escape(entry.workflow), when, str(entry.units), escape(entry.out))
    Console().print(table)


@cache_app.command("verify")
@guarded
def verify(cache: CacheOption = None) -> None:
    """Check every file and remove damaged ones, which the next run computes again."""
    from pano_mvs.engine.cache.maintenance import verify
    from pano_mvs.results.summary import FAILED_ITEMS

    damage, console, shown = verify(open_cache(cache)), Console(), 10
    for what, paths in (
        ("removed, damaged", damage.removed),
        ("incomplete", damage.incomplete),
        ("not of the cache", damage.foreign),
        ("temporary", damage.temporary),
    ):
        for path in paths[:shown]:
            console.say(f"{what}: {escape(path)}")
        if len(paths) > shown:
            console.print(f"{what}: … and {len(paths) - shown} more")
    console.print(
        f"{damage.records} {plural(damage.records, 'record')} and {damage.blobs} "
        f"{plural(damage.blobs, 'blob')} are intact, {len(damage.removed)} damaged",
        highlight=False,
    )
    if damage.removed or damage.incomplete:
        console.print("the next run computes the missing results again")
        raise typer.Exit(FAILED_ITEMS)


@cache_app.command("gc")
@guarded
def collect(
    cache: CacheOption = None,
    delete: Annotated[bool, typer.Option("--delete", help="Delete these results; default: only list them.")] = False,
    unused: Annotated[
        str, typer.Option("--unused", metavar="TIME", help="Keep results computed within this time.")
    ] = "1d",
    older_than: Annotated[
        str,
        typer.Option("--older-than", metavar="TIME", help="Forget runs that ended longer ago than this, such as 30d."),
    ] = "",
) -> None:
    """List or delete results that no latest run and no pin needs."""
    from pano_mvs.engine.cache.maintenance import collect

    console, forget_after_s = Console(), _seconds(older_than) if older_than else None
    found = collect(open_cache(cache), unused_s=_seconds(unused), forget_after_s=forget_after_s, delete=delete)
    for entry in found.runs:
        console.print(f"run of {escape(entry.workflow)} into {escape(entry.out)}, ended {entry.when}", highlight=False)
    records, blobs = len(found.records), len(found.blobs)
    what = f"{records} {plural(records, 'unit')}, {blobs} {plural(blobs, 'blob')}, {size_text(found.size_bytes)}"
    verb = "deleted" if delete else "would delete"
    console.print(f"{verb}: {what}; {size_text(found.kept_bytes)} stay", highlight=False)
    if not delete and (found.records or found.blobs or found.runs):
        console.print("nothing was deleted; use --delete to delete these results")


def _seconds(text: str) -> float:
    """Return a time such as 30d, 12h or 90s in seconds."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smhdw])", text.strip())
    if match is None:
        raise UsageError(f"{text!r} is not a duration: write a number and s, m, h, d or w, such as 30d")
    return float(match[1]) * {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0, "w": 604800.0}[match[2]]


@cache_app.command("pin")
@guarded
def pin(
    run: Annotated[str, typer.Argument(help="The beginning of the run's name in `cache ls`, or its output folder.")],
    name: Annotated[str, typer.Argument(help="Name of the pin.")],
    cache: CacheOption = None,
) -> None:
    """Protect the results of a run from `gc`."""
    kept = open_cache(cache).runs.pin(run, name)
    Console().print(
        f"{escape(kept.name)}: {kept.units} {plural(kept.units, 'unit')} of {escape(kept.workflow)} "
        f"{plural(kept.units, 'is', 'are')} kept until `cache unpin`",
        highlight=False,
    )


@cache_app.command("unpin")
@guarded
def unpin(name: Annotated[str, typer.Argument(help="Name of the pin.")], cache: CacheOption = None) -> None:
    """Remove a pin."""
    history = open_cache(cache).runs
    pins = {entry.name: entry for entry in history.entries() if entry.pinned}
    if name not in pins:
        raise UsageError(f"there is no pin {name!r}; there are: {', '.join(sorted(pins)) or 'none'}")
    history.forget(pins[name])
    Console().print(f"{escape(name)} is no longer pinned", highlight=False)
