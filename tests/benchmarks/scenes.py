"""Does a setting hold beyond the scene it was chosen on: `python -m tests.benchmarks.scenes [--set depth.p1=60 …]`.

Runs the dense stages of a workflow (`--workflow`, default known_poses; any file or preset) with true poses on all
synthetic scenes (`pano_mvs.testing.scenes`) and on rendered captures with truth (`--data DIR`, repeatable), and prints
one line per scene: the first range map ("raw"), the consistent pixels and all pixels of the last one, means over the
views. `sky` is the share of pixels without any surface that have a range of confidence 64 or more, and of any.
`--against` measures the same workflow without the settings given by `--set`, too.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pano_mvs.testing.scenes import SCENES
from tests.benchmarks.captures import Capture, read_capture, scene_captures
from tests.benchmarks.dense_chain import DenseChain, mean_of, score_view

HEADER = (
    "| scene | raw PSNR | raw wδ1.05 | raw wAbsRel % | consistent % | its wδ1.05 | its median % | its wAbsRel % "
    "| final PSNR | wMAE | wAbsRel % | wδ1.05 | complete % | sky seen/filled % | CPU s |\n" + "|---" * 15 + "|"
)


def measure(chain: DenseChain, capture: Capture, *, references: int | None) -> list[float]:
    """Return the figures of one line."""
    names = list(capture.panoramas)
    run = chain.run(capture)
    maps = list(run.range_maps.values())
    scored = names[:references] if references else names
    raw, last = ([score_view(step[name], capture.ranges[name]) for name in scored] for step in (maps[0], maps[-1]))
    sky = [[score.sky_seen, score.sky_filled] for score in last if np.isfinite(score.sky_seen)]
    return [
        mean_of(raw, "filled", "psnr_db"),
        mean_of(raw, "filled", "w_delta_105"),
        100 * mean_of(raw, "filled", "w_abs_rel"),
        100 * mean_of(last, "consistent", "w_completeness"),
        mean_of(last, "consistent", "valid_w_delta_105"),
        100 * mean_of(last, "consistent", "median_relative_error"),
        100 * mean_of(last, "consistent", "valid_w_abs_rel"),
        mean_of(last, "filled", "psnr_db"),
        mean_of(last, "filled", "w_mae"),
        100 * mean_of(last, "filled", "w_abs_rel"),
        mean_of(last, "filled", "w_delta_105"),
        100 * mean_of(last, "filled", "w_completeness"),
        *(100 * np.mean(sky, axis=0) if sky else (np.nan, np.nan)),
        sum(run.cpu_s.values()),
    ]


def line(name: str, figures: Sequence[float], *, outdoor: bool) -> str:
    """Return one row of the table; PSNR and MAE say nothing outdoors."""
    form = "{:.2f} {:.3f} {:.2f} {:.1f} {:.3f} {:.2f} {:.2f} {:.2f} {:.3f} {:.2f} {:.3f} {:.1f} {:.0f} {:.0f} {:.1f}"
    cells = [text.format(value) for text, value in zip(form.split(), figures, strict=True)]
    if outdoor:
        cells[0] = cells[7] = cells[8] = "–"
    sky = "–" if np.isnan(figures[12]) else f"{cells[12]}/{cells[13]}"
    return "| " + " | ".join([name, *cells[:12], sky, cells[14]]) + " |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workflow", default="known_poses")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="STAGE.PARAM=VALUE")
    parser.add_argument("--against", action="store_true", help="also without the settings given by --set")
    parser.add_argument("--scene", action="append", choices=list(SCENES), help="only these; default all")
    parser.add_argument("--data", action="append", default=[], type=Path, metavar="DIR", help="captures with truth")
    parser.add_argument("--no-scenes", action="store_true", help="only what --data names")
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--references", type=int, help="score the first few views only; default all")
    parser.add_argument("--seed", type=int, default=0, help="of the synthetic scenes")
    parser.add_argument("--exposure", type=float, default=0.0, help="of the synthetic scenes; 0.15 is a lot")
    given = parser.parse_args()
    folder = Path(tempfile.gettempdir()) / "pano_mvs_benchmark_scenes"
    names = [] if given.no_scenes else given.scene or list(SCENES)
    captures = [read_capture(path, width=given.width).first(given.views) for path in given.data]
    captures += scene_captures(folder, names=names, width=given.width, seed=given.seed, exposure=given.exposure)
    for overrides in [given.overrides, []] if given.against else [given.overrides]:
        print(f"{given.workflow} {' '.join(overrides)}, {given.width}×{given.width // 2}, {given.views} views")
        print(HEADER)
        chain = DenseChain(given.workflow, overrides=overrides)
        for capture in captures:
            figures = measure(chain, capture.first(given.views), references=given.references)
            print(line(capture.name, figures, outdoor=capture.outdoor), flush=True)


if __name__ == "__main__":
    main()
