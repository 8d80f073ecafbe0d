"""`pano-mvs doctor`: run all checks, print the findings, and set the exit code."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.console import Console
from pano_mvs.cli.endings import guarded
from pano_mvs.cli.options import CacheOption, OutOption
from pano_mvs.core.text import plural

if TYPE_CHECKING:
    from pano_mvs.cli.doctor.checks import Finding

_COLOURS = {"ok": "green", "note": "cyan", "warning": "yellow", "failed": "red"}


@guarded
def doctor(
    cache: CacheOption = None,
    out: OutOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Check the installation, the machine and the folders of a run; exit code 2 if a run cannot work."""
    console = Console()
    if console.is_terminal and not as_json:
        with console.status("checking the libraries, which takes a few seconds …"):
            findings = list(all_findings(cache, out))
    else:
        findings = list(all_findings(cache, out))
    show(findings, console, as_json=as_json)
    if any(finding.state == "failed" for finding in findings):
        raise typer.Exit(2)


def all_findings(cache: Path | None = None, out: Path | None = None) -> Iterator[Finding]:
    """Yield the findings of all checks.

    Args:
        cache: the cache folder; by default that of a preset that is run in the current folder.
        out: the folder of the results, with the same default.
    """
    from pano_mvs.cli.cache_commands import cache_root
    from pano_mvs.cli.doctor.checks import (
        folder_finding,
        kernel_cache_finding,
        machine_findings,
        package_findings,
        plugin_findings,
    )
    from pano_mvs.cli.doctor.libraries import library_findings
    from pano_mvs.engine.stages.registry import Registry
    from pano_mvs.session.session import presets_folder

    yield from package_findings()
    yield from library_findings()
    yield from machine_findings()
    yield kernel_cache_finding()
    yield folder_finding("cache", cache_root(cache), "--cache DIR")
    yield folder_finding("results", out or Path("out"), "--out DIR")
    yield from plugin_findings(Registry.installed(), presets_folder())


def show(findings: Sequence[Finding], console: Console, *, as_json: bool = False) -> None:
    """Print the findings as a table with the remedies below it, or as one JSON object."""
    failed = [finding for finding in findings if finding.state == "failed"]
    if as_json:
        text = {"ok": not failed, "findings": [dataclasses.asdict(finding) for finding in findings]}
        console.print(json.dumps(text, indent=1, ensure_ascii=False), highlight=False, markup=False, soft_wrap=True)
        return
    table = Table("", "what", "", "found")
    for group, members in groupby(findings, key=lambda finding: finding.group):
        for idx, finding in enumerate(members):
            state = f"[{_COLOURS[finding.state]}]{finding.state}[/]"
            table.add_row("" if idx else group, escape(finding.what), state, escape(finding.detail))
        table.add_section()
    console.print(table)
    for finding in findings:
        if finding.remedy:
            head = f"[{_COLOURS[finding.state]}]{finding.state}:[/] {escape(finding.what)}"
            console.say(f"{head}: {escape(finding.remedy)}")
    warned = sum(finding.state == "warning" for finding in findings)
    verdict = f"{len(failed)} failed: a run cannot work" if failed else "a run can work"
    console.print(f"{verdict}; {warned} {plural(warned, 'warning')}", highlight=False)
