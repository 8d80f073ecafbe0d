"""Scores of range maps as text tables and as CSV, each beside the score of a constant."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pano_mvs.core.errors import UsageError
from pano_mvs.core.files import write_text
from pano_mvs.core.text import plural, shortened_list
from pano_mvs_evaluation.ranges.evaluate import DepthEvaluation
from pano_mvs_evaluation.ranges.view_scores import BASELINES, DELTAS, PROTOCOLS, ViewScores
from pano_mvs_evaluation.tables import Summary, TextTable

_PROTOCOL_HEADINGS = ("every pixel", "… on sphere", "estimated", "… on sphere")
_LABELS = {"psnr_db": "PSNR dB", "mse": "MSE ×10⁻²", "rmse": "RMSE", "mae": "MAE", "abs_rel": "AbsRel %"} | dict(
    zip(DELTAS, ("δ<1.05 %", "δ<1.25 %", "δ<1.25² %", "δ<1.25³ %"), strict=True)
)
_OTHER_LABELS = {"completeness": "complete %", "median_relative_error": "median %", "ause": "AUSE ×10⁻²"}
_UNSCALED = frozenset({"psnr_db", "rmse", "mae"})  # all other scores are shown times 100
_VIEW_SCORES = "psnr_db", "w_mae", "w_delta_105", "completeness", "valid_w_delta_105", "median_relative_error", "ause"
_MAX_VIEWS = 40
_BASELINE_WORDS = {
    "best": "the best constant range for each score, chosen with the ground truth",
    "median": "a constant range, the median of the view's true ranges",
    "mean": "a constant range, the mean of the view's true ranges",
}


def depth_summary(evaluation: DepthEvaluation, *, baseline: str = "best") -> Summary:
    """Return how range maps were scored, the mean of all scores, and the main scores of each view, as text."""
    if baseline not in BASELINES:
        raise UsageError(f"'{baseline}' is not a baseline: choose one of {', '.join(BASELINES)}")
    views = evaluation.views
    text: list[str | TextTable] = [*_conditions(evaluation, baseline), _mean_table(evaluation, baseline)]
    if len(views) > 1:
        text.append(_view_table(evaluation, baseline))
    if len(views) > _MAX_VIEWS:
        text.append(
            f"these are the {_MAX_VIEWS} of {len(views)} views with the worst δ<1.05; --json and --csv have all"
        )
    nothing_true = [name for name, view in views.items() if not view.pixels]
    for what, names in (
        ("no truth for", evaluation.pairs.without_truth),
        ("no estimate of", evaluation.pairs.without_estimate),
        ("no true range that counts in", nothing_true),
    ):
        if names:
            text.append(f"{what} {shortened_list(names, 5)}: not in the scores")
    return tuple(text)


def write_depth_csv(path: Path, evaluation: DepthEvaluation) -> None:
    """Write a row per view and one for their mean: every score, followed by that of the best constant."""
    pixels = sum(view.pixels for view in evaluation.views.values())
    mean = ViewScores(pixels, float("nan"), evaluation.mean, evaluation.mean_constants)
    names = list(mean.scores)
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    columns = [column for name in names for column in (name, f"best_constant_{name}")]
    rows.writerow(["view", "pixels", "scale", *columns])
    for label, view in [*evaluation.views.items(), ("mean", mean)]:
        pairs = [(view.scores.get(name), view.constants["best"].get(name)) for name in names]
        rows.writerow([label, view.pixels, *map(_number, (view.scale, *(value for pair in pairs for value in pair)))])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, text.getvalue())


def write_depth_scores(folder: Path, evaluation: DepthEvaluation) -> None:
    """Write all figures to scores.json and scores.csv in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(evaluation.to_json(), indent=1, ensure_ascii=False, allow_nan=False)
    write_text(folder / "scores.json", text)
    write_depth_csv(folder / "scores.csv", evaluation)


def _number(value: float | None) -> str:
    return "" if value is None or np.isnan(value) else repr(float(value))


def _conditions(evaluation: DepthEvaluation, baseline: str) -> list[str]:
    """Return how the range maps were scored."""
    settings, views, scale = evaluation.settings, evaluation.views, evaluation.scale
    lines = [
        f"{len(views)} {plural(len(views), 'view')} of {evaluation.source} against {evaluation.truth}",
        f"estimates × {scale.value:.6g}: {scale.reason}",
    ]
    if settings.align == "none":
        lines.append("ranges are not fitted to the ground truth (--align none)")
    else:
        scales = scale.of_views(views)
        fitted = [view.scale / scales[name] for name, view in views.items()]
        lines.append(
            f"RANGES ARE FITTED TO THE GROUND TRUTH, each view by its own factor (--align {settings.align}): "
            f"{min(fitted):.5g} to {max(fitted):.5g}"
        )
    if settings.min_confidence:
        lines.append(f"ranges with a confidence below {settings.min_confidence} count as missing")
    if missing := evaluation.without_mask:
        lines.append(
            f"no mask in --masks for {len(missing)} of {len(views)} {plural(len(views), 'view')}, {missing[0]} first: "
            "all their pixels count unless --mask excludes them"
        )
    for (size, true_size), count in evaluation.sizes.items():
        if size != true_size:
            lines.append(
                f"{count} of the views {plural(count, 'is', 'are')} {size[1]}×{size[0]}, "
                f"{plural(count, 'its', 'their')} truth {true_size[1]}×{true_size[0]}: read at the true pixels, "
                "interpolated only between pixels of one surface"
            )
    lines.append(
        f"a missing range is an error as large as the truth in “every pixel”; peak {settings.peak:g}; in brackets "
        f"{_BASELINE_WORDS[baseline]}"
    )
    return lines


def _mean_table(evaluation: DepthEvaluation, baseline: str) -> TextTable:
    scores, constant = evaluation.mean, evaluation.mean_constants[baseline]

    def cells(*names: str) -> tuple[str, ...]:
        return tuple(f"{_shown(name, scores)} ({_shown(name, constant)})" if name else "" for name in names)

    count = sum(view.pixels > 0 for view in evaluation.views.values())
    labels = _LABELS | {limit.name: _bad_label(limit.name) for limit in evaluation.settings.bad}
    rows = [(label, *cells(*(f"{prefix}{name}" for prefix in PROTOCOLS))) for name, label in labels.items()]
    rows.append(("complete %", *cells("completeness", "w_completeness", "", "")))
    rows.append(("median %", *cells("", "", "median_relative_error", "w_median_relative_error")))
    if "ause" in scores:
        rows.append(("AUSE ×10⁻²", *cells("", "", "plain_ause", "ause")))
    return TextTable((f"mean of {count}" if count > 1 else "one view", *_PROTOCOL_HEADINGS), tuple(rows))


def _view_table(evaluation: DepthEvaluation, baseline: str) -> TextTable:
    """Return the main scores of the views that are worst in δ<1.05."""
    views = evaluation.views
    names = [name for name in _VIEW_SCORES if any(name in view.scores for view in views.values())]
    worst = sorted(views, key=lambda name: np.nan_to_num(views[name].scores["w_delta_105"], nan=np.inf))[:_MAX_VIEWS]
    shown = {label: view for label, view in views.items() if label in worst}
    return TextTable(
        ("view", *map(_view_heading, names)),
        tuple((label, *(_shown(name, view.scores) for name in names)) for label, view in shown.items()),
        tuple(("constant", *(_shown(name, view.constants[baseline]) for name in names)) for view in shown.values()),
    )


def _view_heading(name: str) -> str:
    label = (_LABELS | _OTHER_LABELS)[name.removeprefix("valid_").removeprefix("w_")]
    return f"{label}{', seen' if name.startswith('valid_') else ''}{', sphere' if 'w_' in name else ''}"


def _bad_label(name: str) -> str:
    absolute = name.startswith("bad_abs_")
    return f"bad > {name.removeprefix('bad_abs_')}" if absolute else f"bad > {name.removeprefix('bad_')} %"


def _shown(name: str, scores: Mapping[str, float]) -> str:
    """Return a score for display, "–" if it is missing."""
    factor = 1.0 if name.removeprefix("valid_").removeprefix("w_") in _UNSCALED else 100.0
    value = factor * scores.get(name, float("nan"))
    if np.isnan(value):
        return "–"
    return f"{value:z.3g}" if abs(value) < 1 else f"{value:.2f}" if abs(value) < 99.995 else f"{value:.1f}"
