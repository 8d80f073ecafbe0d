"""Render the summary of a run as one self-contained HTML page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from pano_mvs.core.files import write_text
from pano_mvs.report import figures
from pano_mvs.report.camera_map import camera_maps
from pano_mvs.report.pictures import previews
from pano_mvs.report.verdict import verdict


def write_report(out_dir: Path, summary: Mapping[str, Any]) -> None:
    """Write `report.html`: no script, no network, every picture within.

    Args:
        out_dir: the output folder; previews are looked up below it.
        summary: what run.json holds; every key may be missing:
            workflow {name, path}, version, started, seconds, exit_code,
            stages [{name, use, units, run, cached, failed, blocked, seconds, metrics}],
            failures [{stage, item, cause, consequence, remedy}], notes [text],
            poses {registered [name], rejected {name: reason}, centers [[x, y, z]] in the order of `registered`, frame,
            scale, metric, up [x, y, z], links [[name, name, inliers]]},
            scores {poses {metric: value}, views {image: {metric: value}}, notes [text]},
            views [{name, preview, completeness, consistent}], cloud {points}, workflow_text, versions {name: version}.
    """
    environment = Environment(
        loader=PackageLoader("pano_mvs.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"share": figures.share, "duration": figures.duration, "figure": figures.figure,
                            "words": figures.words}  # fmt: skip
    poses = dict(summary.get("poses") or {})
    page = environment.get_template("report.html.j2").render(
        run=_with_defaults(summary),
        verdict=verdict(summary),
        poses={"registered": [], "rejected": {}, "frame": "", "scale": ""} | poses,
        maps=camera_maps(poses),
        previews=previews(out_dir, summary.get("views") or []),
        scores=figures.score_tables(summary.get("scores") or {}),
    )
    write_text(out_dir / "report.html", page)


def _with_defaults(summary: Mapping[str, Any]) -> dict[str, Any]:
    empty_stage: dict[str, Any] = {"name": "", "use": "", "units": 0, "run": 0, "cached": 0, "failed": 0, "blocked": 0}
    empty_stage |= {"seconds": 0.0, "metrics": {}}
    empty_failure = {"stage": "", "item": "", "cause": "", "consequence": "", "remedy": ""}
    stages = [empty_stage | stage for stage in summary.get("stages") or []]
    return {
        "name": (summary.get("workflow") or {}).get("name") or "pano-mvs",
        "path": (summary.get("workflow") or {}).get("path") or "",
        "version": summary.get("version") or "",
        "started": summary.get("started") or "",
        "seconds": summary.get("seconds"),
        "stages": stages,
        "longest": max([stage["seconds"] or 0 for stage in stages], default=0) or 1,
        "failures": [empty_failure | failure for failure in summary.get("failures") or []],
        "notes": summary.get("notes") or [],
        "workflow_text": summary.get("workflow_text") or "",
        "versions": summary.get("versions") or {},
    }
