"""Judge the poses of a finished run by its range maps, whichever stages computed them."""

from __future__ import annotations

from collections.abc import Mapping

from pano_mvs.algorithms.filters.consistency import Agreement, view_doubts
from pano_mvs.engine.running.run import Run
from pano_mvs.scene import Poses, RangeMap
from pano_mvs.session.final_stages import chain_of, latest

_FIGURES = tuple(Agreement.__dataclass_fields__)


def add_dense_doubts(run: Run) -> None:
    """Mark views that other views contradict as doubtful, so that the run ends with exit code 3.

    The figures of `Agreement` are used from the last stage of the range maps that reports them;
    filters.consistency does. Cameras that are doubted already keep their reason.
    """
    poses = latest(run, Poses)
    stage = _compared_stage(run)
    if poses is not None and stage:
        name, figures = stage
        groups, centers = poses.groups, poses.centers
        for group in range(len(poses.worlds)):
            inside = {image: centers[idx] for idx, image in enumerate(poses.names) if groups[idx] == group}
            for image, reason in view_doubts(figures, inside).items():
                run.result.doubts.setdefault(image, (name, reason))
    if run.result.doubts and run.result.exit_code == 0:
        run.result.exit_code = 3


def _compared_stage(run: Run) -> tuple[str, Mapping[str, Agreement]] | None:
    """Return the last stage of the range maps that compared the views, and what it found of each."""
    metrics = {summary.name: summary.unit_metrics for summary in run.result.stages}
    for name in reversed(chain_of(run.workflow, run.graph, RangeMap)):
        found = {
            view: Agreement(*(values[figure] for figure in _FIGURES))
            for view, values in metrics.get(name, {}).items()
            if all(figure in values for figure in _FIGURES)
        }
        if found:
            return name, found
    return None
