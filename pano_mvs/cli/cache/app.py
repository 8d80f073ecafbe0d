"""`pano-mvs cache …`: the typer side of cache_command."""

from __future__ import annotations

from typing import Annotated

import typer

from pano_mvs.cli.console import Console
from pano_mvs.cli.error_messages import guarded
from pano_mvs.cli.options import CacheOption

cache_app = typer.Typer(
    help="Look after a cache. Nothing is ever deleted unless `gc --delete` is asked for.", no_args_is_help=True
)


@cache_app.command("du")
@guarded
def usage(cache: CacheOption = None) -> None:
    """Show how much each stage takes."""
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
def verify(
    cache: CacheOption = None,
    drop_unproven: Annotated[
        bool, typer.Option("--drop-unproven", help="Remove results of earlier versions that are not proven.")
    ] = False,
) -> None:
    """Check every byte; damaged files are removed, and computed again by the next run.

    Results of earlier versions that may be of images that changed during a run are listed as not proven.
    """
    from pano_mvs.cli.cache.command import open_cache, verify_cache

    raise typer.Exit(verify_cache(open_cache(cache), Console(), drop_unproven=drop_unproven))


@cache_app.command("gc")
@guarded
def collect(
    cache: CacheOption = None,
    delete: Annotated[bool, typer.Option("--delete", help="Delete it; else it is only shown.")] = False,
    unused: Annotated[
        str, typer.Option("--unused", metavar="TIME", help="Keep what was computed within this time.")
    ] = "1d",
    older_than: Annotated[
        str, typer.Option("--older-than", metavar="TIME", help="Forget runs that ended longer ago, such as 30d.")
    ] = "",
) -> None:
    """Show what no latest run of a workflow into a folder, and no pin, needs."""
    from pano_mvs.cli.cache.command import collect_cache, open_cache

    collect_cache(open_cache(cache), Console(), delete=delete, unused=unused, older_than=older_than)


@cache_app.command("pin")
@guarded
def pin(
    run: Annotated[str, typer.Argument(help="The beginning of a run's name in `cache ls`, or its output folder.")],
    name: Annotated[str, typer.Argument(help="A name for the pin.")],
    cache: CacheOption = None,
) -> None:
    """Keep what a run used, whatever runs after it."""
    from pano_mvs.cli.cache.command import open_cache, pin_run

    pin_run(open_cache(cache), Console(), run, name)


@cache_app.command("unpin")
@guarded
def unpin(name: Annotated[str, typer.Argument(help="The pin's name.")], cache: CacheOption = None) -> None:
    """Give up a pin."""
    from pano_mvs.cli.cache.command import open_cache, unpin_run

    unpin_run(open_cache(cache), Console(), name)
