"""The paper's Tables 2 and 3 on rendered captures with truth.

S. Yang, K. Kim, Y. Lee, "Dense Depth Estimation from Multiple 360-degree Images Using Virtual Depth". 2, 3 and 4
cameras are the first views of a capture, the reference is view 0; windows 5, 7, 9; poses known or estimated from the
pictures, with and without translation scale factors. Estimated ranges are multiplied by the scale that aligns the
camera centres with the true ones, and by nothing else; pixels without surface are left out; every other pixel counts
(FILLED). MSE is that of range / 10, ×10⁻². A capture's figures stand beside the paper's if its folder is called
classroom or smallroom (the paper rendered its own pictures of them: comparable in kind, not to the digit).

Rows of presets (`--preset quality`, repeatable) are the same protocol with that workflow's own poses and settings, its
other views swept too, as its consistency check needs them. Prints Markdown.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace

from pano_mvs.algorithms.poses.frame.metric_scale import unit_translations
from pano_mvs.geometry.pose_errors import align_centers
from pano_mvs.scene import Poses
from pano_mvs.session.session import presets_folder
from tools.benchmarks.captures import Capture, read_capture
from tools.benchmarks.dense_chain import DenseChain
from tools.benchmarks.depth_metrics import constant_baseline, depth_metrics
from tools.benchmarks.poses.sparse_chain import SparseChain
from tools.benchmarks.table import print_table

# What the paper reports: (cameras, poses) to MSE ×10⁻² and PSNR, window 7 (Table 2), …
PAPER_TABLE_2 = {
    "classroom": {
        (4, "known"): (0.198, 27.06),
        (4, "estimated"): (0.193, 27.18),
        (4, "estimated, no scale factors"): (0.439, 23.59),
        (2, "known"): (0.205, 26.90),
        (2, "estimated"): (0.259, 25.88),
    },
    "smallroom": {
        (4, "known"): (0.288, 25.42),
        (4, "estimated"): (0.303, 25.19),
        (4, "estimated, no scale factors"): (0.709, 21.49),
        (2, "known"): (0.503, 23.02),
        (2, "estimated"): (0.540, 22.71),
    },
}
# … and (cameras, window) to PSNR, poses estimated (Table 3).
PAPER_TABLE_3 = {
    "classroom": {2: (24.69, 25.88, 25.61), 3: (25.29, 26.59, 25.81), 4: (26.02, 27.18, 25.11)},
    "smallroom": {2: (22.18, 22.71, 21.27), 3: (22.31, 23.51, 22.45), 4: (23.73, 25.19, 24.48)},
}
RIVALS = {"classroom": ("UniFuse", 26.71), "smallroom": ("360SD-Net", 22.36)}
WINDOWS = (5, 7, 9)
SAMPLE = presets_folder() / "samples" / "classroom"
KNOWN, ESTIMATED, UNSCALED = "known", "estimated", "estimated, no scale factors"
HEADER = ("cameras", "window", "poses", "MSE ×10⁻²", "PSNR", "the paper", "wδ<1.05", "wMAE")
ABLATIONS = {
    "no bilateral filter of the pictures": ["depth.prefilter_diameter=0"],
    "sources looked up where they are, not turned first": ["depth.derotate=false"],
    "no bilateral solver (raw winner)": ["smooth.keep_confidence=1"],
    **{f"solver λ {value}": [f"smooth.smoothness={value}"] for value in (4, 16, 64, 128, 256, 512)},
    "λ 128, solver on 1/range": ["smooth.domain=inverse"],
    "λ 16, solver on 1/range": ["smooth.domain=inverse", "smooth.smoothness=16"],
}


def score(chain: DenseChain, capture: Capture, poses: Poses | None) -> SimpleNamespace:
    """Return the scores of view 0 by the dense stages of a workflow, with these poses or the true ones."""
    name = next(iter(capture.panoramas))
    run = chain.run(capture, poses=poses, references=[name])
    scale = 1.0
    if poses is not None:
        found = {image: poses.cam_from_world(idx) for idx, image in enumerate(poses.names)}
        scale = align_centers(found, {image: capture.poses[image] for image in found}).scale
    last = list(run.range_maps.values())[-1]
    return depth_metrics(last[name].range, capture.ranges[name], scale=scale)


def paper_rows(capture: Capture, workflow: str) -> Iterator[Sequence[object]]:
    """Yield the rows of both tables, by the workflow's own poses and by the true ones."""
    yield row("–", "–", "the median of the truth everywhere", constant_baseline(next(iter(capture.ranges.values()))))
    if capture.name in RIVALS:
        name, psnr = RIVALS[capture.name]
        yield "–", "–", f"best rival in the paper, {name}", "", "", f"{psnr:.2f}", "", ""
    sparse = SparseChain(workflow)
    chains = {window: DenseChain(workflow, overrides=[f"depth.window={window}"]) for window in WINDOWS}
    for cameras in (2, 3, 4):
        part = capture.first(cameras)
        estimated = sparse.poses(part)
        if len(estimated.names) < cameras:
            yield cameras, "", f"{ESTIMATED}: only {len(estimated.names)} registered", "", "", "", "", ""
        ways: dict[str, Poses | None] = {KNOWN: None, ESTIMATED: estimated}
        if cameras > 2:
            ways[UNSCALED] = unit_translations(estimated)
        for window, chain in chains.items():
            for way, poses in ways.items():
                said = reported(capture.name, cameras, window, way)
                yield row(cameras, window, way, score(chain, part, poses), paper=said)


def reported(name: str, cameras: int, window: int, way: str) -> str:
    """Return what the paper says of a row, if anything."""
    if window == 7 and (cameras, way) in PAPER_TABLE_2.get(name, {}):
        mse, psnr = PAPER_TABLE_2[name][cameras, way]
        return f"{mse:.3f} / {psnr:.2f}"
    if way == ESTIMATED and name in PAPER_TABLE_3:
        return f"{PAPER_TABLE_3[name][cameras][WINDOWS.index(window)]:.2f}"
    return "–"


def row(cameras: object, window: object, way: str, found: SimpleNamespace, *, paper: str = "–") -> list[object]:
    """Return one row of a table."""
    scores = f"{found.w_delta_105:.3f}", f"{found.w_mae:.3f}"
    return [cameras, window, way, f"{100 * found.mse:.3f}", f"{found.psnr_db:.2f}", paper, *scores]


def main(
    data: list[Path] | None = None, workflow: str = "paper", preset: list[str] | None = None, width: int | None = None
) -> None:
    """Print the tables of all captures.

    Args:
        data: captures with truth; default: the sample that is included.
        workflow: with the paper's stages under the paper's names.
        preset: also these workflows.
        width: of the pictures; default their own.
    """
    for folder in data or [SAMPLE]:
        capture = read_capture(folder, width=width)
        four = capture.first(4)
        print(f"\n### {capture.name}\n")
        print_table(HEADER, paper_rows(capture, workflow))
        print(f"\n4 cameras, window 7, known poses, `{workflow}` except for one thing:\n")
        chains = {label: DenseChain(workflow, overrides=overrides) for label, overrides in ABLATIONS.items()}
        print_table(HEADER, (row(4, 7, label, score(chain, four, None)) for label, chain in chains.items()))
        if preset:
            print("\nOther workflows, 4 cameras:\n")
        for name in preset or ():
            ways = {KNOWN: None, ESTIMATED: SparseChain(name).poses(four)}
            rows = (row(4, f"`{name}`", way, score(DenseChain(name), four, poses)) for way, poses in ways.items())
            print_table(HEADER, rows)
