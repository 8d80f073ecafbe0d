"""Options of `pano-mvs cache`; `command` does the work."""

from __future__ import annotations

from typing import Annotated

import typer

from pano_mvs.cli.console import Console
from pano_mvs.cli.error_messages import guarded
from pano_mvs.cli.options import CacheOption

cache_app = typer.Typer(
    help="Inspect and clean the cache. Only `gc --delete` and `verify` delete files.", no_args_is_help=True
)


@cache_app.command("du")
@guarded
def usage(cache: CacheOption = None) -> None:
    """Show the disk space used by each stage."""
    from pano_mvs.cli.cache.command import open_cache, show_usage

    show_usage(open_cache(cache), Console())


@cache_app.command("ls")
@guarded
def runs(cache: CacheOption = None) -> None:
    """List the runs and pins whose results are kept."""
    from pano_mvs.cli.cache.command import open_cache, show_runs

    show_runs(open_cache(cache), Console())


@cache_app.command("verify")
@guarded
def verify(cache: CacheOption = None) -> None:
    """Check every file and remove damaged ones, which the next run computes again."""
    from pano_mvs.cli.cache.command import open_cache, verify_cache

    raise typer.Exit(verify_cache(open_cache(cache), Console()))


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
    from pano_mvs.cli.cache.command import collect_cache, open_cache

    collect_cache(open_cache(cache), Console(), delete=delete, unused=unused, older_than=older_than)


@cache_app.command("push")
@guarded
def push(
    url: Annotated[str, typer.Argument(help="Folder, or URL such as s3://bucket/cache or ssh://host/folder.")],
    cache: CacheOption = None,
) -> None:
    """Copy results to another place, from which `cache pull` fetches them; what is there is not copied again.

    Every file is checked against its digest first.
    """
    from pano_mvs.cli.cache.command import open_cache, push_cache

    push_cache(open_cache(cache), Console(), url)


@cache_app.command("pull")
@guarded
def pull(
    url: Annotated[str, typer.Argument(help="Folder or URL that `cache push` has written.")],
    cache: CacheOption = None,
) -> None:
    """Copy results from another place into the cache, so that a run of the same images goes on with them.

    Every file is checked against its digest; damaged ones are refused.
    """
    from pano_mvs.cli.cache.command import cache_root, pull_cache

    pull_cache(cache_root(cache), Console(), url)


@cache_app.command("pin")
@guarded
def pin(
    run: Annotated[str, typer.Argument(help="The beginning of the run's name in `cache ls`, or its output folder.")],
    name: Annotated[str, typer.Argument(help="Name of the pin.")],
    cache: CacheOption = None,
) -> None:
    """Protect the results of a run from `gc`."""
    from pano_mvs.cli.cache.command import open_cache, pin_run

    pin_run(open_cache(cache), Console(), run, name=name)


@cache_app.command("unpin")
@guarded
def unpin(name: Annotated[str, typer.Argument(help="Name of the pin.")], cache: CacheOption = None) -> None:
    """Remove a pin."""
    from pano_mvs.cli.cache.command import open_cache, unpin_run

    unpin_run(open_cache(cache), Console(), name)
