"""Render the summary of a run as one self-contained HTML page."""

from __future__ import annotations

import base64
import hashlib
from collections import Counter
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from pano_mvs.core.files import write_text
from pano_mvs.core.text import plural
from pano_mvs.report import figures
from pano_mvs.report.content import gather
from pano_mvs.report.earlier_page import Kept
from pano_mvs.report.results import Results
from pano_mvs.report.verdict import Verdict

MOST_SHOWN = 200
"""Failures, rejected pairs and the like that the page lists; run.json has all of them."""


def write_report(out_dir: Path, summary: Mapping[str, Any], results: Results | None = None) -> Verdict:
    """Write `report.html`: no network, every picture within, at most 30 MB; return the verdict that it gives.

    Args:
        out_dir: the output folder; previews are looked up below it, and the pictures of the page that is there are
            used again where they are of the same values.
        summary: what run.json holds; every key may be missing:
            workflow {name, path, overrides}, version, started, seconds, exit_code, stopped, executor, machine,
            stages [{name, use, params, units, run, cached, failed, blocked, seconds, unit_seconds, metrics}],
            failures [{stage, item, cause, consequence, log}], blocked, warnings [text], notes [text],
            poses {registered [name], rejected {name: reason}, centers [[x, y, z]] in the order of `registered`, frame,
            scale, metric, up [x, y, z], doubts {name: reason}, confirmed {name: [share, expected]},
            links [[name, name, inliers, candidates, residual_deg]]},
            rejected {name: {stage, reason}}, doubts {name: {stage, reason}},
            scores {poses {metric: value}, views {image: {metric: value}}, notes},
            all_scores {stage: scores}, views [{name, preview, completeness, consistent}], cloud {points}, files {name},
            workflow_text, versions {name: version}.
        results: the values behind it; None where only the summary is known.

    Raises:
        StoreError: if the page cannot be written.
    """
    kept = Kept.of_page(out_dir / "report.html")
    content = gather(out_dir, summary, results or Results(), kept)
    script = _resource("report.js")
    page = _environment().get_template("report.html.j2").render(
        run=_with_defaults(summary),
        content=content,
        most_shown=MOST_SHOWN,
        facts=kept.facts,
        script=Markup(script),  # noqa: S704  # ours
        style=Markup(_resource("report.css")),  # noqa: S704  # ours
        script_digest=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii"),
    )  # fmt: skip
    write_text(out_dir / "report.html", page)
    return content.verdict


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("pano_mvs.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"share": figures.share, "duration": figures.duration, "figure": figures.figure,
                            "words": figures.words, "degrees": figures.degrees, "plural": plural}  # fmt: skip
    return environment


def _resource(name: str) -> str:
    return (files("pano_mvs.report") / "templates" / name).read_text(encoding="utf-8")


def _with_defaults(summary: Mapping[str, Any]) -> dict[str, Any]:
    empty_stage: dict[str, Any] = {"name": "", "use": "", "units": 0, "run": 0, "cached": 0, "failed": 0, "blocked": 0}
    empty_stage |= {"seconds": 0.0, "unit_seconds": None, "metrics": {}, "params": {}}
    empty_failure = {"stage": "", "item": "", "cause": "", "consequence": "", "remedy": "", "log": ""}
    stages = [empty_stage | stage for stage in summary.get("stages") or []]
    workflow = summary.get("workflow") or {}
    return {
        "name": workflow.get("name") or "pano-mvs",
        "path": workflow.get("path") or "",
        "overrides": workflow.get("overrides") or [],
        "version": summary.get("version") or "",
        "started": summary.get("started") or "",
        "seconds": summary.get("seconds"),
        "stages": stages,
        "longest": max([stage["seconds"] or 0 for stage in stages], default=0) or 1,
        "failures": [empty_failure | failure for failure in summary.get("failures") or []],
        "blocked": len(summary.get("blocked") or []),
        "notes": list(dict.fromkeys([*(summary.get("warnings") or []), *(summary.get("notes") or [])])),
        "workflow_text": summary.get("workflow_text") or "",
        "executor": summary.get("executor") or {},
        "machine": summary.get("machine") or {},
        "versions": summary.get("versions") or {},
        "folders": _folders(summary.get("files") or {}),
    }


def _folders(names: Mapping[str, Any]) -> list[tuple[str, int]]:
    """Return the files at the top of the output folder, and its folders with the number of files below."""
    count = Counter(f"{name.partition('/')[0]}/" if "/" in name else name for name in names)
    return sorted(count.items())
