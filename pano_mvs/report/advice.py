"""What to do next time, from the summary of a run and its range maps."""

from __future__ import annotations

from collections.abc import Sequence

from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.results.coverage import ViewCoverage, coverage, coverage_from_fact, coverage_key, fact_of
from pano_mvs.results.next_time import Suggestion, suggestions
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary

MAX_SUGGESTIONS = 12
"""Suggestions that the page shows."""

_MAX_COMPARED = 60


def advice(
    summary: RunSummary, values: StoredValues, earlier: EarlierPage, *, chosen: Sequence[str]
) -> tuple[Suggestion, ...]:
    """Return what to do next time, the most urgent first.

    Args:
        summary: of the run, with shares of the unmasked sphere.
        values: of the run.
        earlier: the earlier page, whose figures are reused.
        chosen: names of the views to examine if there are more than 60.
    """
    names = [view.name for view in summary.views]
    return suggestions(summary, _coverage(values, earlier, names if len(names) <= _MAX_COMPARED else chosen))


def _coverage(values: StoredValues, earlier: EarlierPage, names: Sequence[str]) -> dict[str, ViewCoverage]:
    if not values.digest("poses"):
        return {}
    key = coverage_key(values, names)
    known = coverage_from_fact(earlier.fact(key))
    if known is None:
        known = coverage(values, names)
        earlier.keep(key, fact_of(known))
    return known
