"""Scores of range maps as tables, JSON and CSV, each beside what a constant scores."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.box import SIMPLE
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pano_mvs.algorithms.metrics.range_errors import DELTAS
from pano_mvs.algorithms.metrics.view_scores import BASELINES, PROTOCOLS, Judging, ViewScores, mean_scores
from pano_mvs.cli.evaluate_depth_inputs import FoundScale
from pano_mvs.core.errors import UsageError
from pano_mvs.core.files import write_text
from pano_mvs.core.text import plural

_PROTOCOL_HEADINGS = ("every pixel", "… on sphere", "estimated", "… on sphere")
_LABELS = {"psnr_db": "PSNR dB", "mse": "MSE ×10⁻²", "rmse": "RMSE", "mae": "MAE", "abs_rel": "AbsRel %"} | dict(
    zip(DELTAS, ("δ<1.05 %", "δ<1.25 %", "δ<1.25² %", "δ<1.25³ %"), strict=True)
)
_FACTORS = {"psnr_db": 1.0, "rmse": 1.0, "mae": 1.0}  # all others are shown in hundredths
_OF_A_VIEW = "psnr_db", "w_mae", "w_delta_105", "completeness", "valid_w_delta_105", "median_relative_error", "ause"
_MOST_VIEWS = 40
_BASELINE_WORDS = {
    "best": "the constant that is best for the very score, chosen by the truth",
    "median": "the median of the view's true ranges everywhere",
    "mean": "the mean of the view's true ranges everywhere",
}


@dataclass(frozen=True)
class DepthReport:
    """The scores of range maps.

    Attributes:
        source: what was judged.
        truth: against what.
        judging: how.
        scale: from the estimates' unit to the truth's, before any fit.
        views: name to scores.
        without_truth: names of estimates that have no truth.
        without_estimate: names that the truth knows and nobody estimated.
        sizes: ((height, width) of the estimate, that of the truth) to the number of such views.
        without_mask: names of views that have no mask where there is a folder of masks.
    """

    source: str
    truth: str
    judging: Judging
    scale: FoundScale
    views: Mapping[str, ViewScores]
    without_truth: Sequence[str] = ()
    without_estimate: Sequence[str] = ()
    sizes: Mapping[tuple[tuple[int, int], tuple[int, int]], int] = field(default_factory=dict)
    without_mask: Sequence[str] = ()

    def mean(self) -> dict[str, float]:
        """Return the mean of each score over the views."""
        return mean_scores([view.scores for view in self.views.values()])

    def mean_constant(self, baseline: str) -> dict[str, float]:
        """Return the mean over the views of what a constant scores."""
        return mean_scores([view.constants[baseline] for view in self.views.values()])


def report_json(report: DepthReport) -> str:
    """Return all figures as JSON; what is no finite number (the PSNR of no error, the mean of nothing) is null."""
    judging = report.judging
    values = {
        "source": report.source,
        "truth": report.truth,
        "peak": judging.peak,
        "align": judging.align,
        "min_confidence": judging.min_confidence,
        "scale": report.scale.value,
        "scale_reason": report.scale.reason,
        "mean": _finite(report.mean()),
        "mean_constant": {name: _finite(report.mean_constant(name)) for name in BASELINES},
        "views": {
            name: {
                "pixels": view.pixels,
                "scale": view.scale,
                "scores": _finite(view.scores),
                "constant": {baseline: _finite(found) for baseline, found in view.constants.items()},
            }
            for name, view in report.views.items()
        },
        "without_truth": list(report.without_truth),
        "without_estimate": list(report.without_estimate),
        "without_mask": list(report.without_mask),
    }
    return json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False)


def write_csv(path: Path, report: DepthReport) -> None:
    """Write a row for each view and one for their mean: every score, and each followed by that of the best constant."""
    mean = ViewScores(sum(view.pixels for view in report.views.values()), float("nan"), report.mean(),
                      {"best": report.mean_constant("best")})  # fmt: skip
    names = list(mean.scores)
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(
        ["view", "pixels", "scale", *(column for name in names for column in (name, f"best_constant_{name}"))]
    )
    for label, view in [*report.views.items(), ("mean", mean)]:
        pairs = [(view.scores.get(name), view.constants["best"].get(name)) for name in names]
        cells = ["" if value is None or np.isnan(value) else repr(float(value)) for pair in pairs for value in pair]
        rows.writerow([label, view.pixels, "" if np.isnan(view.scale) else repr(float(view.scale)), *cells])
    write_text(path, text.getvalue())


def print_report(report: DepthReport, console: Console, *, baseline: str) -> None:
    """Print how it was judged, the mean of all scores, and the main ones of each view.

    Raises:
        UsageError: if there is no such baseline.
    """
    if baseline not in BASELINES:
        raise UsageError(f"'{baseline}' is no baseline: choose one of {', '.join(BASELINES)}")
    for line in _conditions(report, baseline):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    console.print(_mean_table(report, baseline))
    if len(report.views) > 1:
        console.print(_view_table(report, baseline))
    if len(report.views) > _MOST_VIEWS:
        console.print(f"these are the {_MOST_VIEWS} of {len(report.views)} views with the worst δ<1.05; --json and "
                      "--csv have all", highlight=False, markup=False, soft_wrap=True)  # fmt: skip
    nothing_true = [name for name, view in report.views.items() if not view.pixels]
    for what, names in (("no truth for", report.without_truth), ("no estimate of", report.without_estimate),
                        ("no true range that counts in", nothing_true)):  # fmt: skip
        if names:
            shown = ", ".join(names[:5]) + (f" … ({len(names)} in all)" if len(names) > 5 else "")
            console.print(f"{what} {shown}: not in the scores", highlight=False, markup=False, soft_wrap=True)


def _conditions(report: DepthReport, baseline: str) -> list[str]:
    judging = report.judging
    count = len(report.views)
    lines = [
        f"{count} {plural(count, 'view')} of {report.source} against {report.truth}",
        f"estimates × {report.scale.value:.6g}: {report.scale.reason}",
    ]
    if judging.align == "none":
        lines.append("ranges are not fitted to the truth (--align none)")
    else:
        scales = report.scale.of_views(report.views)
        fitted = [view.scale / scales[name] for name, view in report.views.items()]
        lines.append(f"RANGES ARE FITTED TO THE TRUTH, each view by a factor of its own (--align {judging.align}): "
                     f"{min(fitted):.5g} to {max(fitted):.5g}")  # fmt: skip
    if judging.min_confidence:
        lines.append(f"ranges of a confidence below {judging.min_confidence} count as missing")
    if report.without_mask:
        lines.append(f"no mask in --masks for {len(report.without_mask)} of {count} {plural(count, 'view')}, "
                     f"{report.without_mask[0]} first: all of their pixels count that --mask does not leave "
                     "out")  # fmt: skip
    for (size, true_size), views in report.sizes.items():
        if size != true_size:
            lines.append(f"{views} of the views {plural(views, 'is', 'are')} {size[1]}×{size[0]}, "
                         f"{plural(views, 'its', 'their')} truth {true_size[1]}×{true_size[0]}: read at the true "
                         "pixels, between pixels of one surface alone")  # fmt: skip
    lines.append(f"a missing range is an error as large as the truth in “every pixel”; peak {judging.peak:g}; in "
                 f"brackets {_BASELINE_WORDS[baseline]}")  # fmt: skip
    return lines


def _mean_table(report: DepthReport, baseline: str) -> Table:
    scores, constant = report.mean(), report.mean_constant(baseline)
    judged = sum(view.pixels > 0 for view in report.views.values())
    table = Table(f"mean of {judged}" if judged > 1 else "one view", *_PROTOCOL_HEADINGS)
    for name, label in (_LABELS | {limit.name: _bad_label(limit.name) for limit in report.judging.bad}).items():
        table.add_row(label, *(_cell(f"{prefix}{name}", scores, constant) for prefix in PROTOCOLS))
    complete = (_cell(name, scores, constant) for name in ("completeness", "w_completeness"))
    table.add_row("complete %", *complete, "", "")
    median = (_cell(name, scores, constant) for name in ("median_relative_error", "w_median_relative_error"))
    table.add_row("median %", "", "", *median)
    if "ause" in scores:
        table.add_row("AUSE ×10⁻²", "", "", *(_cell(name, scores, constant) for name in ("plain_ause", "ause")))
    return table


def _view_table(report: DepthReport, baseline: str) -> Table:
    names = [name for name in _OF_A_VIEW if any(name in view.scores for view in report.views.values())]
    table = Table("view", *(_view_heading(name) for name in names), box=SIMPLE, collapse_padding=True)
    worst = sorted(report.views, key=lambda name: np.nan_to_num(report.views[name].scores["w_delta_105"], nan=np.inf))
    worst = worst[:_MOST_VIEWS]
    for label, view in report.views.items():
        if label not in worst:
            continue
        constant = view.constants[baseline]
        table.add_row(escape(label), *(_shown(name, view.scores) for name in names))
        table.add_row("constant", *(_shown(name, constant) for name in names), style="dim", end_section=True)
    return table


def _view_heading(name: str) -> str:
    base = name.removeprefix("valid_").removeprefix("w_")
    label = (_LABELS | {"completeness": "complete %", "median_relative_error": "median %", "ause": "AUSE ×10⁻²"})[base]
    where = ", seen" if name.startswith("valid_") else ""
    return label + where + (", sphere" if "w_" in name else "")


def _bad_label(name: str) -> str:
    relative = not name.startswith("bad_abs_")
    return f"bad > {name.removeprefix('bad_')} %" if relative else f"bad > {name.removeprefix('bad_abs_')}"


def _cell(name: str, scores: Mapping[str, float], constant: Mapping[str, float]) -> str:
    return f"{_shown(name, scores)} ({_shown(name, constant)})"


def _shown(name: str, scores: Mapping[str, float]) -> str:
    """Return a score as it is printed, "–" where there is none."""
    value = _FACTORS.get(name.removeprefix("valid_").removeprefix("w_").removeprefix("plain_"), 100.0) * scores.get(
        name, float("nan")
    )
    if np.isnan(value):
        return "–"
    return f"{value:z.3g}" if abs(value) < 1 else f"{value:.2f}" if abs(value) < 99.995 else f"{value:.1f}"


def _finite(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: float(value) if np.isfinite(value) else None for name, value in values.items()}
