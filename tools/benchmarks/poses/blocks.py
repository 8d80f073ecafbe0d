"""Seams of a walk that is solved in blocks.

The walk of `simulated_walk` with its loop closures is solved as a whole; in blocks that are aligned; in blocks that are
divided again by the poses of these, so that they overlap where the path returns; and then adjusted together. The error
of a pair of cameras is that of their relative position, in percent of a step: consecutive cameras of one block and of
two (at a seam), and cameras at places to which the path returns, of one block and of two.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.blocks import MergedBlocks, adjust_merged, align_blocks, divide_capture, merge_blocks
from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.geometry import Rigid3, similarity_from_points
from pano_mvs.scene import Poses, TwoView
from pano_mvs.scene.pose_groups import split_groups
from tests.algorithms.poses.synthetic_path import PathCapture, window_matches
from tools.benchmarks.poses.simulated_walk import FAR_IN_ORDER, pairs_of_walk, simulated_walk
from tools.benchmarks.table import print_table

RETURNS_WITHIN = 1.2


def main(views: int = 300, size: int = 90, overlap: int = 20, keypoints: int = 250, seed: int = 1) -> None:
    """Print the table."""
    rng = np.random.default_rng(seed)
    capture = simulated_walk(rng, views, keypoints=keypoints)
    names = list(capture.poses)
    two_views = {}
    for a, b in pairs_of_walk(capture, closures=True):
        matches = window_matches(rng, capture, names[a], names[b])
        if len(matches) >= 8:
            found = capture.features[names[a]], capture.features[names[b]]
            two_views[names[a], names[b]] = verify_pair(*found, matches, rng=rng)

    def in_blocks(positions: dict[str, NDArray[np.float64]] | None) -> MergedBlocks:
        parts = divide_capture(names, size=size, overlap=overlap, positions=positions)
        blocks = [_solved(capture, two_views, part) for part in parts]
        alignment = align_blocks([block.cameras for block in blocks])
        similarities = [similarity for similarity in alignment.world_from_block if similarity is not None]
        return merge_blocks(blocks, similarities, order=names, reference=0)

    plain = in_blocks(None)
    again = in_blocks(dict(zip(plain.poses.names, plain.poses.centers, strict=True)))
    whole = MergedBlocks(_solved(capture, two_views, names), np.zeros(views, np.intp))
    rows = {"whole": whole, "blocks": plain, "divided again": again, "adjusted together": adjust_merged(again)}
    print_table(
        ["", "consecutive", "at seams", "returns, one block", "returns, two blocks", "largest error, % of the path"],
        [[label, *_errors(merged, capture.poses, capture.length)] for label, merged in rows.items()],
    )


def _solved(capture: PathCapture, two_views: dict[tuple[str, str], TwoView], names: Sequence[str]) -> Poses:
    chosen = set(names)
    features = {name: capture.features[name] for name in names}
    pairs = {pair: view for pair, view in two_views.items() if chosen.issuperset(pair)}
    return split_groups(refine_poses(solve_scaled_translation(features, pairs, rng=np.random.default_rng(1))))[0]


def _errors(merged: MergedBlocks, truth: dict[str, Rigid3], length: float) -> Iterator[str]:
    poses, owner = merged.poses, merged.owner
    true = np.array([truth[name].center for name in poses.names])
    laid = similarity_from_points(poses.centers, true)
    centers, rotations = laid.apply(poses.centers), poses.rotations @ laid.rotation.T
    true_rotations = np.array([truth[name].rotation for name in poses.names])
    step = float(np.linalg.norm(np.diff(true, axis=0), axis=1).mean())
    apart = np.linalg.norm(true[:, None] - true, axis=-1)
    later = np.arange(len(true)) - np.arange(len(true))[:, None]
    for chosen in (later == 1, (later > FAR_IN_ORDER) & (apart < RETURNS_WITHIN)):
        first, second = np.nonzero(chosen)
        found = np.einsum("nij,nj->ni", rotations[first], centers[second] - centers[first])
        wanted = np.einsum("nij,nj->ni", true_rotations[first], true[second] - true[first])
        errors = 100 * np.linalg.norm(found - wanted, axis=1) / step
        across = owner[first] != owner[second]
        for part in (errors[~across], errors[across]):
            yield f"{np.median(part):.3f} (≤ {part.max():.3f}, {len(part)})" if len(part) else "—"
    yield f"{100 * float(np.linalg.norm(centers - true, axis=1).max()) / length:.4f}"
