"""`pano-mvs cache push` and `cache pull`: copy a cache to or from a folder, SSH or an object store."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

from pano_mvs.cli.cache_commands import cache_root, open_cache
from pano_mvs.cli.console import Console
from pano_mvs.cli.endings import guarded
from pano_mvs.cli.options import CacheOption
from pano_mvs.core.memory import size_text
from pano_mvs.core.text import plural

if TYPE_CHECKING:  # a command loads what it needs itself
    from pano_mvs_queues.remote_cache import Copied


@guarded
def push(
    url: Annotated[str, typer.Argument(help="Folder, or URL such as s3://bucket/cache or ssh://host/folder.")],
    cache: CacheOption = None,
) -> None:
    """Copy results to another place, from which `cache pull` fetches them; what is there is not copied again.

    Every file is checked against its digest first.
    """
    from pano_mvs_queues.remote_cache import RemoteCache

    store, console = open_cache(cache), Console()
    with _copying(console) as progress:
        copied = RemoteCache(url).push(store, progress)
    _print_copied(copied, url, console)


@guarded
def pull(
    url: Annotated[str, typer.Argument(help="Folder or URL that `cache push` has written.")],
    cache: CacheOption = None,
) -> None:
    """Copy results from another place into the cache, so that a run of the same images goes on with them.

    Every file is checked against its digest; damaged ones are refused.
    """
    from pano_mvs.engine.cache.store import Store
    from pano_mvs_queues.remote_cache import RemoteCache

    root, remote, console = cache_root(cache), RemoteCache(url), Console()
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
