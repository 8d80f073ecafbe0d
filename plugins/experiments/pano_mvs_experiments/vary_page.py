"""The page of an experiment: its combinations over all captures and for each, and how far each is from the best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from pano_mvs.core.paths import is_file
from pano_mvs.core.text import plural
from pano_mvs_experiments.vary_results import Best, CaptureResult, CombinationResult, Variation, VariedRun, direction_of

_REPORT = "report.html"


@dataclass(frozen=True)
class Cell:
    """A metric of a combination."""

    text: str  # mean and deviation; "–" if it is not known
    share: float | None  # 0 for the worst combination of the table, 1 for the best; None if all are equal or unknown


@dataclass(frozen=True)
class Row:
    """A combination in a table."""

    result: CombinationResult
    values: tuple[str, ...]  # of the settings that vary
    cells: tuple[Cell, ...]
    is_best: bool
    reports: tuple[tuple[str, str], ...]  # the seed and the address of the report of each run, relative to the page


@dataclass(frozen=True)
class ResultTable:
    """The combinations over one capture, or over all."""

    title: str
    text: str  # which is the best, or why none is; empty if this was not asked for
    rows: tuple[Row, ...]

    @property
    def has_reports(self) -> bool:
        """Whether any run of the table has a report."""
        return any(row.reports for row in self.rows)


def vary_page(found: Variation) -> str:
    """Return the page, one file of HTML that needs no network."""
    whole = "all captures" if found.by_capture else next(iter(found.captures), "")
    parts = [(whole, CaptureResult(found.combinations, found.best), () if found.by_capture else found.runs)]
    parts += [
        (capture, result, tuple(run for run in found.runs if run.capture == capture))
        for capture, result in found.by_capture.items()
    ]
    failed = [run for run in found.runs if run.exit_code is not None and not run.is_finished]
    return _template().render(
        found=found,
        size=" × ".join(
            f"{count} {plural(count, what)}"
            for count, what in (
                (len(found.combinations), "combination"),
                (len(found.captures), "capture"),
                (found.seeds, "seed"),
            )
        ),
        headings=found.varied or ("combination",),
        tables=[_table(found, *part) for part in parts],
        failed=[
            (run.out.relative_to(found.out).as_posix(), run.stopped or f"exit code {run.exit_code}") for run in failed
        ],
        done=sum(run.exit_code is not None for run in found.runs),
    )


@cache  # the page is written after each run
def _template() -> Template:
    environment = Environment(
        loader=PackageLoader("pano_mvs_experiments", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("vary.html.j2")


def _table(found: Variation, title: str, result: CaptureResult, runs: Sequence[VariedRun]) -> ResultTable:
    columns = [_column(metric, result.combinations, found.best) for metric in found.metrics]
    rows = [
        Row(
            each,
            tuple(each.settings.get(target, "") for target in found.varied) or (each.name,),
            tuple(column[idx] for column in columns),
            result.best is not None and each.name == result.best.name,
            tuple(
                (str(run.seed), (run.out.relative_to(found.out) / _REPORT).as_posix())
                for run in runs
                if run.combination == each.name and is_file(run.out / _REPORT)
            ),
        )
        for idx, each in enumerate(result.combinations)
    ]
    return ResultTable(title, result.best.text if result.best is not None else "", tuple(rows))


def _column(metric: str, combinations: Sequence[CombinationResult], best: Best | None) -> list[Cell]:
    averages = [result.averages.get(metric) for result in combinations]
    means = [average.mean for average in averages if average is not None]
    low, high = min(means, default=0.0), max(means, default=0.0)
    is_small = (best.direction if best is not None and best.metric == metric else direction_of(metric)[1]) == "min"

    def share(mean: float) -> float | None:
        if high <= low:
            return None
        part = (mean - low) / (high - low)
        return 1 - part if is_small else part

    return [Cell("–", None) if average is None else Cell(str(average), share(average.mean)) for average in averages]
