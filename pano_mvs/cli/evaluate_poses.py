"""Compare poses from any file with true ones from any file."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

from rich.console import Console
from rich.table import Table

from pano_mvs.algorithms.metrics.pose_report import PoseReport, report_poses, summary
from pano_mvs.core.errors import InputError
from pano_mvs.core.text import plural
from pano_mvs.io.images.names import match_image_names
from pano_mvs.io.poses.files import read_groups, read_poses
from pano_mvs.scene import Poses


def evaluate_poses(model: Path, truth_path: Path, console: Console, *, as_json: bool) -> None:
    """Print how far the poses in a model are from the truth.

    Args:
        model: anything that `read_poses` reads.
        truth_path: likewise, with the true poses.
        console: where to print.
        as_json: print one JSON object and nothing else.

    Raises:
        InputError: if the two have fewer than two images in common.
    """
    groups, truth = read_groups(model), read_poses(truth_path)
    estimated = groups[0]
    ours = _truth_to_model(estimated, truth)
    if len(ours) < 2:
        raise InputError(f"{model} and {truth_path} have {len(ours) or 'no'} {plural(len(ours), 'image')} in common, "
                         f"two are needed to compare poses. The model has {_shown(estimated.names)}, the truth "
                         f"{_shown(truth.names)}")  # fmt: skip
    model_idx = {name: idx for idx, name in enumerate(estimated.names)}
    report = report_poses(
        {name: estimated.cam_from_world(model_idx[ours[name]]) for name in ours},
        {name: truth.cam_from_world(idx) for idx, name in enumerate(truth.names)},
    )
    unit = "m" if truth.metric else "units of the truth"
    without_truth = [name for name in estimated.names if name not in ours.values()]
    if as_json:
        values = report.to_json() | {"model": str(model), "truth": str(truth_path), "unit": unit}
        print(json.dumps(values | {"without_truth": without_truth}, indent=1, ensure_ascii=False))
        return
    _print(report, unit, console)
    if len(groups) > 1:
        count = sum(len(group.names) for group in groups[1:])
        further = f"{len(groups) - 1} further {plural(len(groups) - 1, 'group')} of {count} {plural(count, 'image')}"
        console.print(f"{further} in {model}, each with a frame of its own, count as not registered",
                      highlight=False, markup=False, soft_wrap=True)  # fmt: skip
    if without_truth:
        console.print(f"no truth for {_shown(without_truth)}", highlight=False, markup=False)


def _truth_to_model(estimated: Poses, truth: Poses) -> dict[str, str]:
    """Return the truth's image names with the model's names for them; one that two could mean is left out."""
    matched = match_image_names(estimated.names, truth.names)
    claims = Counter(matched.values())
    return {known: name for name, known in matched.items() if claims[known] == 1}


def _print(report: PoseReport, unit: str, console: Console) -> None:
    pairs, some = report.pairs, report.registered_pairs
    console.print(
        f"{pairs.registered} of {pairs.expected} {plural(pairs.expected, 'image')} registered", highlight=False
    )
    table = Table(
        f"over {len(some.pairs)} {plural(len(some.pairs), 'pair')} of registered images", "median", "mean", "max"
    )
    for label, values in (
        ("rotation °", some.rotation_deg),
        ("translation direction °", some.direction_deg),
        ("pair (the larger) °", some.pair_deg),
    ):
        table.add_row(label, *(f"{value:.4f}" for value in summary(values).values()))
    if report.centers is not None:
        distances = report.centers.distances
        table.add_row(f"camera centre, {unit}", *(f"{value:.5g}" for value in summary(distances).values()))
        shares = summary(100 * distances / report.centers.extent)
        table.add_row("camera centre, % of extent", *(f"{value:.4f}" for value in shares.values()))
    console.print(table)
    auc = ", ".join(f"{100 * value:.1f} @ {limit:g}°" for limit, value in pairs.auc.items())
    console.print(
        f"AUC over {plural(len(pairs.pairs), 'one pair', f'all {len(pairs.pairs)} pairs')}, %: {auc}", highlight=False
    )
    if some.scale_ratio_max == some.scale_ratio_max:
        console.print(f"translation scale ratios: median {100 * some.scale_ratio_median:.3f} %, largest "
                      f"{100 * some.scale_ratio_max:.3f} % off", highlight=False)  # fmt: skip
    if report.centers is not None:
        console.print(f"extent {report.centers.extent:.5g} {unit}; one unit of the model is "
                      f"{report.centers.scale:.6g} {unit}", highlight=False)  # fmt: skip
    else:
        console.print(f"camera centres are not compared: {report.no_centers}", highlight=False)


def _shown(names: tuple[str, ...] | list[str]) -> str:
    return ", ".join(names[:3]) + (f" … ({len(names)} in all)" if len(names) > 3 else "")
