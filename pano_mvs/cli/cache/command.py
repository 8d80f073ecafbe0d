"""The cache commands: size, content, integrity, and results that can be deleted."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from rich.markup import escape
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn
from rich.table import Table

from pano_mvs.cli.console import Console
from pano_mvs.core.errors import UsageError
from pano_mvs.core.paths import is_denied, is_file
from pano_mvs.core.text import plural
from pano_mvs.engine.cache.maintenance import collect, size_on_disk, usage_of, verify
from pano_mvs.engine.cache.remote import Copied, RemoteCache
from pano_mvs.engine.cache.store import Store
from pano_mvs.results.summary import CACHE_VARIABLE, FAILED_ITEMS

_SHOWN = 10
_UNITS_S = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0, "w": 604800.0}


def cache_root(cache: Path | None) -> Path:
    """Return the folder given by `--cache`, $PANO_MVS_CACHE, or `.pano-mvs` in the current folder."""
    return cache or Path(os.environ.get(CACHE_VARIABLE) or ".pano-mvs")


def push_cache(store: Store, console: Console, url: str) -> None:
    """Copy what a remote cache lacks to it."""
    with _copying(console) as progress:
        copied = RemoteCache(url).push(store, progress)
    _print_copied(copied, url, console)


def pull_cache(root: Path, console: Console, url: str) -> None:
    """Copy what a cache, which need not exist yet, lacks from a remote one."""
    remote = RemoteCache(url)
    with _copying(console) as progress:
        copied = remote.pull(Store(root), progress)
    _print_copied(copied, str(root), console)


@contextmanager
def _copying(console: Console) -> Iterator[Callable[[int, int], None]]:
    """Show a bar, and yield what moves it."""
    columns = TextColumn("copying"), BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=True) as bars:
        bar = bars.add_task("copying", total=None)
        yield lambda done, total: bars.update(bar, completed=done, total=total)


def _print_copied(copied: Copied, to: str, console: Console) -> None:
    files = f"{copied.files} {plural(copied.files, 'file')}, {size_text(copied.size_bytes)}"
    console.say(f"copied to {escape(to)}: {files}; {copied.present} were there already")


def open_cache(cache: Path | None) -> Store:
    """Open the cache given by `--cache`, $PANO_MVS_CACHE, or `.pano-mvs` in the current folder."""
    root = cache_root(cache)
    if not is_file(root / "layout.json"):
        if is_denied(root / "layout.json"):
            raise UsageError(f"{root}: this folder cannot be listed (permission denied). Correct its permissions")
        raise UsageError(
            f"{root} is not a cache of pano-mvs; specify one with --cache DIR (it lies beside the workflow file "
            "as .pano-mvs, or where you ran a preset by its name)"
        )
    return Store(root)


def show_usage(store: Store, console: Console) -> None:
    """Print the disk space used by each stage."""
    table = Table("stage", "units", "size", "computed in")
    for usage in usage_of(store):
        table.add_row(usage.stage, str(usage.units), size_text(usage.size_bytes), f"{usage.seconds:.0f} s")
    console.print(table)
    console.print(f"{escape(str(store.root))}: {size_text(size_on_disk(store))} on the disk", highlight=False)


def show_runs(store: Store, console: Console) -> None:
    """Print the runs and the pins whose results a collection keeps."""
    table = Table("run", "workflow", "ended", "units", "results in")
    for entry in store.runs.entries():
        when = datetime.fromisoformat(entry.when).astimezone().strftime("%Y-%m-%d %H:%M")
        name = f"{entry.name} (pin)" if entry.pinned else entry.name
        table.add_row(escape(name), escape(entry.workflow), when, str(entry.units), escape(entry.out))
    console.print(table)


def verify_cache(store: Store, console: Console) -> int:
    """Check every file of the cache; return the exit code."""
    damage = verify(store)
    for what, paths in (
        ("removed, damaged", damage.removed),
        ("incomplete", damage.incomplete),
        ("not of the cache", damage.foreign),
        ("temporary", damage.temporary),
    ):
        for path in paths[:_SHOWN]:
            console.say(f"{what}: {escape(path)}")
        if len(paths) > _SHOWN:
            console.print(f"{what}: … and {len(paths) - _SHOWN} more")
    console.print(
        f"{damage.records} {plural(damage.records, 'record')} and {damage.blobs} "
        f"{plural(damage.blobs, 'blob')} are intact, {len(damage.removed)} damaged",
        highlight=False,
    )
    if not damage.removed and not damage.incomplete:
        return 0
    console.print("the next run computes the missing results again")
    return FAILED_ITEMS


def collect_cache(store: Store, console: Console, *, delete: bool, unused: str, older_than: str) -> None:
    """Print the results that nothing needs any more; delete them on request."""
    forget_after_s = seconds_from_text(older_than) if older_than else None
    found = collect(store, unused_s=seconds_from_text(unused), forget_after_s=forget_after_s, delete=delete)
    for entry in found.runs:
        console.print(f"run of {escape(entry.workflow)} into {escape(entry.out)}, ended {entry.when}", highlight=False)
    records, blobs = len(found.records), len(found.blobs)
    what = f"{records} {plural(records, 'unit')}, {blobs} {plural(blobs, 'blob')}, {size_text(found.size_bytes)}"
    verb = "deleted" if delete else "would delete"
    console.print(f"{verb}: {what}; {size_text(found.kept_bytes)} stay", highlight=False)
    if not delete and (found.records or found.blobs or found.runs):
        console.print("nothing was deleted; use --delete to delete these results")


def pin_run(store: Store, console: Console, run: str, *, name: str) -> None:
    """Protect the results of a run from garbage collection."""
    pin = store.runs.pin(run, name)
    console.print(
        f"{escape(pin.name)}: {pin.units} {plural(pin.units, 'unit')} of {escape(pin.workflow)} "
        f"{plural(pin.units, 'is', 'are')} kept until `cache unpin`",
        highlight=False,
    )


def unpin_run(store: Store, console: Console, name: str) -> None:
    """Remove a pin."""
    pins = {entry.name: entry for entry in store.runs.entries() if entry.pinned}
    if name not in pins:
        raise UsageError(f"there is no pin {name!r}; there are: {', '.join(sorted(pins)) or 'none'}")
    store.runs.forget(pins[name])
    console.print(f"{escape(name)} is no longer pinned", highlight=False)


def size_text(size_bytes: int) -> str:
    """Return a size as text, such as 1.3 GB."""
    size = float(size_bytes)
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} TB"


def seconds_from_text(text: str) -> float:
    """Return a time such as 30d, 12h or 90s in seconds."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smhdw])", text.strip())
    if match is None:
        raise UsageError(f"{text!r} is not a duration: write a number and s, m, h, d or w, such as 30d")
    return float(match[1]) * _UNITS_S[match[2]]
