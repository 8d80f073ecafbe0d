"""The results of an experiment: metrics of each run, their means and deviations, the best, as records, JSON and CSV."""

from __future__ import annotations

import csv
import io
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from pano_mvs.core.errors import UsageError
from pano_mvs.results.figures import figure, median, significant
from pano_mvs.results.records import UnitCounts
from pano_mvs.results.summary import FAILED_ITEMS, RunSummary

SCHEMA = 1
Direction = Literal["max", "min"]

METRICS = {
    "registered": "number of registered cameras",
    "completeness": "mean share of the pixels of a view that have a range",
    "confirmed": "mean share of the pixels of a view on which other views agree",
    "points": "number of points of the cloud",
    "seconds": "computing time of all units, also of those that were cached, from their measured times",
}
"""Figures of a run beside those of its stages."""

_DEFAULT = ("registered", "completeness", "confirmed", "seconds")
_DEFAULT_SCORES = ("registered", "median_pair_error_deg", "w_mae", "w_delta_105", "completeness")
_SMALLER_IS_BETTER = ("error", "mae", "rmse", "abs_rel", "bad_", "ause", "area", "residual", "std", "seconds", "_s")


@dataclass(frozen=True, slots=True)
class VariedRun:
    """What one run of an experiment found."""

    capture: str  # name of the capture
    combination: str  # name of the combination
    seed: int
    out: Path  # its output folder
    exit_code: int | None = None  # as of `RunSummary`; None if it has not run yet
    stopped: str = ""  # why it ended early, or the error that ended it; empty if it did not
    seconds: float | None = None  # that it took, without what was cached
    units: UnitCounts = field(default_factory=UnitCounts)
    metrics: Mapping[str, float] = field(default_factory=dict)  # of `METRICS`, and STAGE.METRIC

    @property
    def is_finished(self) -> bool:
        """Whether the run reached its end, perhaps with failed or doubtful items."""
        return self.exit_code in (0, FAILED_ITEMS)


@dataclass(frozen=True, slots=True)
class Average:
    """A metric of a combination: the mean over its captures of the mean over its seeds."""

    mean: float
    # standard deviation over the seeds of the mean over the captures; None with fewer than two seeds
    deviation: float | None
    captures: int  # number of captures that have the metric

    def __str__(self) -> str:
        """Return the mean and the deviation as text."""
        return figure(self.mean) + (f" ± {significant(self.deviation)}" if self.deviation else "")


@dataclass(frozen=True, slots=True)
class CombinationResult:
    """What the runs of one combination found together."""

    name: str
    settings: Mapping[str, str]  # STAGE.PARAM to its value, as `--set` takes it; those that vary
    exit_code: int | None  # the highest of its runs; None if none of them has run yet
    averages: Mapping[str, Average]  # of the chosen metrics that at least one of its runs has


@dataclass(frozen=True, slots=True)
class Best:
    """The best combination by one metric."""

    metric: str
    direction: Direction  # whether the largest or the smallest is the best
    name: str  # of the combination; empty if the first two do not differ by more than chance
    text: str  # the same in a sentence


@dataclass(frozen=True, slots=True)
class CaptureResult:
    """What the runs over one capture found."""

    combinations: tuple[CombinationResult, ...]
    best: Best | None = None  # None unless it was asked for


@dataclass(frozen=True, slots=True)
class Variation:
    """The results of an experiment."""

    out: Path
    workflow: str  # its name
    workflow_path: str  # its file
    settings: Mapping[str, str]  # those that all runs have in common, as `--set` takes them
    varied: tuple[str, ...]  # the settings that vary, as STAGE.PARAM
    captures: Mapping[str, str]  # name of each capture to its folder; empty for that of the workflow
    seeds: int
    dropped: Mapping[str, str]  # combination that was left out to the one that it equals
    metrics: tuple[str, ...]  # the chosen metrics
    combinations: tuple[CombinationResult, ...]
    runs: tuple[VariedRun, ...]
    best: Best | None = None  # None unless it was asked for
    by_capture: Mapping[str, CaptureResult] = field(default_factory=dict)  # of each capture alone, if there are several

    @property
    def disagreeing(self) -> tuple[str, ...]:
        """The captures for which another combination than the best over all captures is the best."""
        if self.best is None or not self.best.name:
            return ()
        own = {name: each.best.name for name, each in self.by_capture.items() if each.best is not None}
        return tuple(name for name, best in own.items() if best not in ("", self.best.name))

    @property
    def computed(self) -> int:
        """Number of units that the runs computed."""
        return sum(run.units.run for run in self.runs)

    @property
    def exit_code(self) -> int:
        """0 if all runs finished without failed or doubtful items, else 3."""
        return FAILED_ITEMS if any(run.exit_code != 0 for run in self.runs) else 0

    def __getitem__(self, name: str) -> CombinationResult:
        """Return what the runs of one combination found.

        Raises:
            KeyError: if there is no combination with this name.
        """
        return {each.name: each for each in self.combinations}[name]

    def to_json(self) -> dict[str, Any]:
        """Return the content of vary.json, as values that `json.dumps` takes."""
        return {
            "schema": SCHEMA,
            "workflow": {"name": self.workflow, "path": self.workflow_path},
            "settings": dict(self.settings),
            "varied": list(self.varied),
            "captures": dict(self.captures),
            "seeds": self.seeds,
            "dropped": dict(self.dropped),
            "metrics": list(self.metrics),
            "combinations": [{"settings": dict(each.settings)} | _to_json(each) for each in self.combinations],
            "best": None if self.best is None else asdict(self.best),
            "by_capture": {
                name: {
                    "combinations": [_to_json(each) for each in result.combinations],
                    "best": None if result.best is None else asdict(result.best),
                }
                for name, result in self.by_capture.items()
            },
            "runs": [
                {
                    "capture": run.capture,
                    "combination": run.combination,
                    "seed": run.seed,
                    "out": run.out.relative_to(self.out).as_posix(),
                    "exit_code": run.exit_code,
                    "stopped": run.stopped,
                    "seconds": run.seconds,
                    "units": run.units.model_dump(),
                    "metrics": dict(run.metrics),
                }
                for run in self.runs
            ],
        }

    def to_csv(self) -> str:
        """Return the content of vary.csv: a line for each run."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        counts = ("run", "cached", "failed", "blocked")
        own = ("capture", "combination", "seed", *self.varied, "exit_code", *(f"units_{name}" for name in counts))
        writer.writerow([*own, *self.metrics])
        settings = {each.name: each.settings for each in self.combinations}
        for run in self.runs:
            writer.writerow(
                [
                    *(run.capture, run.combination, run.seed),
                    *(settings[run.combination].get(target) for target in self.varied),
                    run.exit_code,
                    *(getattr(run.units, name) for name in counts),
                    *(run.metrics.get(name) for name in self.metrics),
                ]
            )
        return stream.getvalue()


def _to_json(result: CombinationResult) -> dict[str, Any]:
    averages = {name: asdict(average) for name, average in result.averages.items()}
    return {"name": result.name, "exit_code": result.exit_code, "metrics": averages}


def metrics_of(summary: RunSummary, seconds: float | None) -> dict[str, float]:
    """Return all metrics of a run: those of `METRICS`, the metrics of its stages, and its scores as STAGE.SCORE.

    The score of the views is the median over them.

    Args:
        seconds: computing time of all its units; None if it is not known.
    """
    poses, views = summary.poses, summary.views
    own: dict[str, float | None] = {
        "registered": len(poses.registered) if poses else None,
        "completeness": _mean([view.completeness for view in views]),
        "confirmed": _mean([view.consistent for view in views]),
        "points": summary.cloud.points,
        "seconds": seconds,
    }
    for stage in summary.stages:
        own |= {f"{stage.name}.{name}": value for name, value in stage.metrics.items()}
    for name, scores in summary.scores_by_stage.items():
        stage_name = name if len(summary.scores_by_stage) > 1 else _scoring_stage(summary) or name
        known = dict.fromkeys(score for values in scores.views.values() for score in values)
        own |= {f"{stage_name}.{score}": median([view.get(score) for view in scores.views.values()]) for score in known}
        own |= {
            f"{stage_name}.{score}": value
            for score, value in scores.poses.items()
            if isinstance(value, int | float) and not isinstance(value, bool)
        }
    return {name: float(value) for name, value in own.items() if value is not None and math.isfinite(value)}


def _scoring_stage(summary: RunSummary) -> str:
    return next((stage.name for stage in summary.stages if stage.use.startswith("evaluate.")), "")


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None


def default_metrics(runs: Sequence[VariedRun]) -> tuple[str, ...]:
    """Return the metrics to show if none is chosen: the scores if there is truth, else what every run reports."""
    known = dict.fromkeys(name for run in runs for name in run.metrics)
    stages = dict.fromkeys(name.rpartition(".")[0] for name in known if name.endswith((".w_mae", ".pairs_deg")))
    pose_stages = dict.fromkeys(name.rpartition(".")[0] for name in known if name.endswith(".median_pair_error_deg"))
    scores = [f"{stage}.{score}" for stage in {**pose_stages, **stages} for score in _DEFAULT_SCORES]
    shown = [*scores, "seconds"] if scores else _DEFAULT
    return tuple(name for name in shown if name in known)


def averages_of(runs: Sequence[VariedRun], metrics: Sequence[str]) -> dict[str, Average]:
    """Return the metrics of the runs of one combination."""
    found = {}
    captures = list(dict.fromkeys(run.capture for run in runs))
    seeds = list(dict.fromkeys(run.seed for run in runs))
    for name in metrics:
        values = {(run.capture, run.seed): run.metrics[name] for run in runs if name in run.metrics}
        by_capture = [_mean([values.get((capture, seed)) for seed in seeds]) for capture in captures]
        known = [mean for mean in by_capture if mean is not None]
        if not known:
            continue
        by_seed = [
            statistics.fmean(values[capture, seed] for capture in captures)
            for seed in seeds
            if all((capture, seed) in values for capture in captures)
        ]
        deviation = statistics.stdev(by_seed) if len(by_seed) > 1 else None
        found[name] = Average(statistics.fmean(known), deviation, len(known))
    return found


def direction_of(best: str) -> tuple[str, Direction]:
    """Return the metric that `METRIC[:max|min]` names, and which end is the best.

    Without `:max` or `:min`, errors and times are best if they are small, others if they are large.

    Raises:
        UsageError: if it ends with something else.
    """
    name, colon, word = best.partition(":")
    if colon and word not in ("max", "min"):
        raise UsageError(f"--best {best[:80]}: write {name[:80]}:max if the largest is the best, or {name[:80]}:min")
    if word:
        return name, "max" if word == "max" else "min"
    last = name.rpartition(".")[2]
    is_small = any(part in last for part in _SMALLER_IS_BETTER[:-1]) or last.endswith(_SMALLER_IS_BETTER[-1])
    return name, "min" if is_small else "max"


def best_of(combinations: Sequence[CombinationResult], best: str, *, captures: int, is_repeatable: bool) -> Best:
    """Return the best combination; none if it is not ahead of the second by more than the deviation over seeds.

    Combinations that lack the metric for a capture are not compared.

    Args:
        best: `METRIC[:max|min]`.
        captures: number of captures.
        is_repeatable: whether the workflow draws no random numbers, so that one seed is enough.
    """
    name, direction = direction_of(best)
    make: Callable[[str, str], Best] = lambda winner, text: Best(name, direction, winner, text)  # noqa: E731
    sign = -1 if direction == "max" else 1
    known = [
        (each.name, each.averages[name])
        for each in combinations
        if name in each.averages and each.averages[name].captures == captures
    ]
    ranked = sorted(known, key=lambda each: sign * each[1].mean)
    end = "largest" if direction == "max" else "smallest"
    if not ranked:
        return make("", f"no best by {name}: no combination has it for every capture")
    if len(ranked) == 1:
        return make("", f"no best by {name}: only {ranked[0][0]} has it for every capture")
    (first, own), (second, other) = ranked[:2]
    gap = abs(own.mean - other.mean)
    pair = f"{first} ({own}) and {second} ({other})"
    if gap == 0:
        return make("", f"no best by {name}: {pair} are equal")
    deviations = [0.0 if is_repeatable else average.deviation for average in (own, other)]
    if None in deviations:
        return make(
            "",
            f"no best by {name}: {first} has the {end} ({own}), but whether it differs from {second} ({other}) by more "
            "than chance is not known. --seeds 3 measures it",
        )
    most = max(deviation for deviation in deviations if deviation is not None)
    if gap <= most:
        return make(
            "",
            f"no best by {name}: {pair} differ by {figure(gap)}, which is not more than the deviation over seeds "
            f"({figure(most)})",
        )
    return make(
        first,
        f"best by {name} ({end}): {first} with {figure(own.mean)}; the next is {second} with {figure(other.mean)}",
    )
