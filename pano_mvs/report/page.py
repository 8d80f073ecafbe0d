"""Render the summary of a run as one self-contained HTML page."""

from __future__ import annotations

import base64
import hashlib
from collections import Counter
from contextlib import suppress
from functools import cache
from importlib.resources import files
from pathlib import Path

import jinja2
from jinja2 import Environment, FileSystemBytecodeCache, PackageLoader, StrictUndefined
from jinja2.bccache import Bucket
from markupsafe import Markup

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.files import make_folder, write_text
from pano_mvs.core.kernel_cache import user_cache_folder
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
        bytecode_cache=_kept_templates(),
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


class _KeptTemplates(FileSystemBytecodeCache):
    """Compiled templates: compiling them takes longer than all else. A file that is of no use costs only time."""

    def load_bytecode(self, bucket: Bucket) -> None:
        """Load a compiled template, if it was kept."""
        try:
            super().load_bytecode(bucket)
        except Exception:  # a damaged file may raise anything
            bucket.reset()

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Keep a compiled template."""
        with suppress(OSError):
            super().dump_bytecode(bucket)


def _kept_templates() -> _KeptTemplates | None:
    """Return a cache in the user's folder for caches; None if it cannot be written."""
    try:
        folder = user_cache_folder() / "pano-mvs" / "templates"
        make_folder(folder)
    except OSError:
        return None
    compiled_by = digest_from_value([jinja2.__version__, Path(__file__).read_bytes()])  # another one may differ
    return _KeptTemplates(str(folder), f"{compiled_by[:8]}-%s.cache")


def _source(script: str) -> str:
    """Return the expression by which a content security policy allows one inline script."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode('ascii')}'"


def _resource(name: str) -> str:
    return (files("pano_mvs.report") / "templates" / name).read_text(encoding="utf-8")
