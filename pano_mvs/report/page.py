"""Render the summary of a run as one self-contained HTML page."""

from __future__ import annotations

import base64
import hashlib
from collections import Counter
from functools import cache
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from pano_mvs.core.files import write_text
from pano_mvs.core.text import duration_text, plural
from pano_mvs.report.content import MAX_SUGGESTIONS, Content, gather, stage_groups
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.results import figures
from pano_mvs.results.colors import probability_color
from pano_mvs.results.records import Verdict
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary

_SCRIPTS = ("report.js", "cloud_viewer.js")


def write_report(out_dir: Path, summary: RunSummary, values: StoredValues | None = None) -> Verdict:
    """Write `report.html` and return the verdict that it shows; `gather_report` and `write_page` in one step.

    Args:
        out_dir: the output folder; previews are read from it, and the images of an existing page are
            reused if they show the same values.
        values: the values of the run; None if only the summary is known.
    """
    report = gather_report(out_dir, summary, values)
    write_page(out_dir, summary, report)
    return report.verdict


def gather_report(out_dir: Path, summary: RunSummary, values: StoredValues | None = None) -> Content:
    """Return the content of the page; arguments as for `write_report`."""
    earlier = EarlierPage.of_file(out_dir / "report.html")
    return gather(out_dir, summary, values or StoredValues(), earlier=earlier)


def write_page(out_dir: Path, summary: RunSummary, content: Content) -> None:
    """Write `report.html`: one file without references to others, at most 30 MB."""
    scripts = [_resource(name) for name in _SCRIPTS]
    notes = tuple(dict.fromkeys([*summary.warnings, *summary.notes]))
    # the files at the top of the output folder, and its folders with the number of files below
    folders = Counter(f"{name.partition('/')[0]}/" if "/" in name else name for name in summary.files)
    # Failures, rejected pairs and the like that the page lists; run.json has all of them.
    page = (
        _environment()
        .get_template("report.html.j2")
        .render(
            run=summary,
            run_notes=notes,
            folders=sorted(folders.items()),
            stage_groups=stage_groups(summary.stages),
            longest=max((stage.seconds for stage in summary.stages), default=0) or 1,
            content=content,
            most_shown=200,
            most_advice=MAX_SUGGESTIONS,
            facts=content.facts,
            scripts=[Markup(script) for script in scripts],  # noqa: S704  # ours
            style=Markup(_resource("report.css")),  # noqa: S704  # ours
            script_sources=Markup(" ".join(map(_source, scripts))),  # noqa: S704  # digests
        )
    )
    write_text(out_dir / "report.html", page)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("pano_mvs.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "share": figures.share,
        "probability_color": probability_color,
        "duration": duration_text,
        "figure": figures.figure,
        "short": figures.short,
        "words": figures.words,
        "degrees": figures.degrees,
        "plural": plural,
        "pixels": lambda size_hw: f"{size_hw[1]} × {size_hw[0]} px",
    }
    return environment


def _source(script: str) -> str:
    """Return the expression by which a content security policy allows one inline script."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode('ascii')}'"


def _resource(name: str) -> str:
    return (files("pano_mvs.report") / "templates" / name).read_text(encoding="utf-8")
