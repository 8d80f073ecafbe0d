"""A table of runs: the settings in which they differ, chosen metrics, scores, and how each ended."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeGuard

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.text import finite_or_none, shortened_list
from pano_mvs.results.figures import median
from pano_mvs.session.python_calls import as_names
from pano_mvs_lineage.stored_runs import StoredRun, as_paths, find_runs

_SCORES = ("median_pair_error_deg", "registered")
_PATHS = frozenset({"path", "truth"})  # settings whose folders differ wherever a checkout lies


@dataclass(frozen=True)
class RunRow:
    """One run of the table."""

    out: Path
    workflow: str
    started: str  # date and time, ISO 8601 in UTC
    exit_code: int
    seconds: float | None
    registered: int  # number of images with a pose
    images: int  # number of images that the run read
    settings: Mapping[str, Any] = field(default_factory=dict)  # those in which the runs of the table differ
    metrics: Mapping[str, float] = field(default_factory=dict)  # the chosen ones that the run has, and its scores

    def to_json(self) -> dict[str, Any]:
        """Return the row as JSON values."""
        return {
            "out": str(self.out),
            "workflow": self.workflow,
            "started": self.started,
            "exit_code": self.exit_code,
            "seconds": self.seconds,
            "registered": self.registered,
            "images": self.images,
            "settings": dict(self.settings),
            "metrics": {name: finite_or_none(value) for name, value in self.metrics.items()},
        }


@dataclass(frozen=True)
class RunTable:
    """Runs with the settings in which they differ."""

    rows: tuple[RunRow, ...]
    settings: tuple[str, ...]  # `STAGE.SETTING`, in the order of the workflows
    metrics: tuple[str, ...]  # `STAGE.METRIC` or a score, as chosen
    skipped: tuple[str, ...] = ()  # why runs are missing
    notes: tuple[str, ...] = ()  # such as that runs are of different captures

    def to_json(self) -> dict[str, Any]:
        """Return the table as JSON values."""
        return {"runs": [row.to_json() for row in self.rows], "skipped": list(self.skipped), "notes": list(self.notes)}

    @property
    def headings(self) -> tuple[str, ...]:
        """The names of the columns."""
        return "out", "workflow", "started", "exit", "s", "registered", "images", *self.settings, *self.metrics

    def cells(self, row: RunRow) -> tuple[str, ...]:
        """Return the texts of a row, in the order of the columns; empty where a run lacks a value."""
        settings = ("" if row.settings.get(name) is None else str(row.settings[name]) for name in self.settings)
        metrics = (f"{row.metrics[name]:.5g}" if name in row.metrics else "" for name in self.metrics)
        seconds = "" if row.seconds is None else f"{row.seconds:.1f}"
        fixed = (str(row.out), row.workflow, row.started[:19], str(row.exit_code), seconds)
        return *fixed, str(row.registered), str(row.images), *settings, *metrics

    def to_csv(self) -> str:
        """Return the table as CSV with a heading."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(self.headings)
        writer.writerows(map(self.cells, self.rows))
        return stream.getvalue()


def runs(
    folders: str | Path | Iterable[str | Path] = "out", *, metrics: str | Sequence[str] = (), sort: str = ""
) -> RunTable:
    """Return the runs in some folders: what differs in their settings, and what came of it.

    >>> import pano_mvs
    >>> table = pano_mvs.runs(["out"], metrics=["poses.registered"], sort="depth.planes")  # doctest: +SKIP

    Args:
        folders: output folders, or folders of these at any depth.
        metrics: `STAGE.METRIC` of those to list; by default the scores against ground truth of runs that have them.
        sort: the column by which rows are sorted, with `-` before it for the largest first; by default the start. Runs
            without a value come last.

    Raises:
        InputError: if there is no run in a folder.
        UsageError: if no run has a metric or the column to sort by.
    """
    found: list[StoredRun] = []
    skipped: list[str] = []
    for out in find_runs(as_paths(folders)):
        try:
            found.append(StoredRun.open(out))
        except InputError as error:  # of an interrupted or newer version
            skipped.append(str(error))
    if not found:
        raise InputError("no run can be read:\n  " + "\n  ".join(skipped))
    settings = differing([run.settings for run in found])
    chosen = as_names(metrics) or _scores_of(found)
    known = sorted({name for run in found for name in _values_of(run)})
    for name in chosen:
        if name not in known:
            raise UsageError(f"no run has the metric {name!r}; there are: {shortened_list(known, 20)}")
    rows = tuple(_row(run, settings, chosen) for run in found)
    table = RunTable(rows, settings, chosen, tuple(skipped), _captures(found))
    return _sorted(table, sort)


def _captures(found: Sequence[StoredRun]) -> tuple[str, ...]:
    """Return a note if the runs are of captures without an image in common, and one on runs that list no images."""
    captures: list[tuple[set[str], StoredRun]] = []
    for run in found:
        own = set(run.summary.inputs.values())
        if own and not any(own & images for images, _ in captures):
            captures.append((own, run))
    notes = [run.unlisted for run in found if run.unlisted]
    if len(captures) > 1:
        shown = shortened_list([f"{run.summary.source_folder} ({run.out})" for _, run in captures])
        notes.append(f"the runs are of {len(captures)} different captures, whose metrics do not compare: {shown}")
    return tuple(notes)


def differing(settings: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return the settings that differ between runs which have them, in their order; paths of inputs do not count.

    A run may lack a stage, as a partial run does.
    """
    names = dict.fromkeys(name for each in settings for name in each if name.rpartition(".")[2] not in _PATHS)
    return tuple(name for name in names if len({repr(each[name]) for each in settings if name in each}) > 1)


def _row(run: StoredRun, settings: Sequence[str], metrics: Sequence[str]) -> RunRow:
    summary, own, values = run.summary, run.settings, _values_of(run)
    poses = summary.poses
    return RunRow(
        out=run.out,
        workflow=summary.workflow.name,
        started=summary.started,
        exit_code=summary.exit_code,
        seconds=summary.seconds,
        registered=len(poses.registered),
        images=len(summary.inputs) or len(poses.registered) + len(poses.rejected),
        settings={name: own.get(name) for name in settings},
        metrics={name: values[name] for name in metrics if name in values},
    )


def _values_of(run: StoredRun) -> dict[str, float]:
    """Return the metrics of a run, and its scores against ground truth; those of views as the median over them."""
    scores: dict[str, float] = {}
    for stage, each in run.summary.scores_by_stage.items():
        scores |= {f"{stage}.{name}": float(value) for name, value in each.poses.items() if _is_number(value)}
        for name in sorted({name for view in each.views.values() for name in view}):
            value = median([view.get(name) for view in each.views.values()])
            if value is not None:
                scores[f"{stage}.{name}"] = value
    return run.metrics | scores


def _is_number(value: object) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _scores_of(found: Sequence[StoredRun]) -> tuple[str, ...]:
    """Return the scores that a reader looks at first, of runs that have them."""
    wanted = ("median_pair_error_deg", "psnr_db", "w_delta_105", "completeness")
    have = dict.fromkeys(name for run in found for name in _values_of(run))
    stages = dict.fromkeys(stage for run in found for stage in run.summary.scores_by_stage)
    return tuple(f"{stage}.{name}" for stage in stages for name in wanted if f"{stage}.{name}" in have)


def _sorted(table: RunTable, sort: str) -> RunTable:
    name = sort.removeprefix("-") or "started"
    if name not in table.headings:
        raise UsageError(f"--sort {sort}: there is no such column; there are {', '.join(table.headings)}")
    column = table.headings.index(name)

    def place(row: RunRow) -> tuple[int, float, str]:
        text = table.cells(row)[column]
        try:
            return (0, float(text), "")
        except ValueError:
            return (1, 0.0, text)

    rows = sorted(table.rows, key=place, reverse=sort.startswith("-"))
    rows.sort(key=lambda row: not table.cells(row)[column])  # those without a value come last, in either order
    return replace(table, rows=tuple(rows))
