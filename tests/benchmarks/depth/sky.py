"""How much of the sky is found, and what is lost: `python -m tests.benchmarks.depth.sky [--place NAME …]`.

Synthetic places with the sky over a court, behind branches and slats, and through the windows of a room, known poses,
four views, 512×256: `depth.sweep` with 96 planes, `filters.consistency`, `filters.sky`. Prints the share of the pixels
without a surface that is found, and the share of all other pixels that loses its range, of the worst view and on
average, and without the stage the share of the sky on which other views confirm a range.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import pixel_solid_angle
from pano_mvs.scene import Record
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from pano_mvs.testing.scenes import courtyard
from tests.benchmarks.captures import scene_capture
from tests.benchmarks.depth.stored_chain import StoredChain
from tests.synthetic.places import window_room, yard

MAKERS = {maker.__name__: maker for maker in (courtyard, yard, window_room)}
PLACES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("courtyard", {"seed": 11, "sky": "blue"}),
    ("courtyard", {"seed": 11, "sky": "overcast"}),
    ("yard", {"seed": 0, "sky": "blue"}),
    ("yard", {"seed": 0, "sky": "overcast"}),
    ("yard", {"seed": 3, "sky": "clouds", "exposure": 0.1}),
    ("yard", {"seed": 3, "sky": "overcast", "exposure": 0.15}),
    ("window_room", {"seed": 0, "sky": "blue"}),
    ("window_room", {"seed": 0, "sky": "overcast"}),
    ("window_room", {"seed": 3, "sky": "clouds", "exposure": 0.05}),
)
SETTINGS = ("depth.planes=96",)


def shares(found: NDArray[np.bool_], truth: NDArray[np.float32]) -> tuple[float, float]:
    """Return the share of the sky that is found, and that of the rest that is taken for sky, in percent.

    Args:
        found: (H, W), the pixels that are taken for sky.
        truth: (H, W), NaN where there is no surface.
    """
    weights = np.broadcast_to(pixel_solid_angle(found.shape)[:, None], found.shape)
    sky = ~np.isfinite(truth)
    return (
        100 * float(weights[found & sky].sum() / weights[sky].sum()),
        100 * float(weights[found & ~sky].sum() / weights[~sky].sum()),
    )


def line(place: str, arguments: dict[str, Any], *, scratch: Path, width: int) -> str:
    """Return one row of the table."""
    name = " ".join([place, *(f"{key} {value}" for key, value in arguments.items())])
    capture = scene_capture(MAKERS[place](**arguments), scratch / f"{name}-{width}", width=width)
    memory: dict[str, Record] = {}
    chain = StoredChain("known_poses", overrides=SETTINGS, store=scratch / "maps", memory=memory)
    chain.chain.dense = [stage for stage in chain.chain.dense if stage in ("depth", "checked", "sky")]
    maps = chain.run(capture, label=f"{name}-{width}", references=list(capture.panoramas)).range_maps
    rows, confirmed = [], []
    for image, truth in capture.ranges.items():
        sky = maps["sky"][image].sky
        assert sky is not None
        rows.append(shares(sky, truth))
        confirmed.append(shares(maps["checked"][image].confidence >= CONSISTENT_CONFIDENCE[0], truth)[0])
    found, lost = np.array(rows).T
    return (
        f"| {name} | {found.min():.1f} | {found.mean():.1f} | {lost.max():.2f} | {lost.mean():.2f} "
        f"| {np.mean(confirmed):.0f} |"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--place", action="append", choices=list(MAKERS), help="only these; default all")
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--scratch", type=Path, default=Path(tempfile.gettempdir()) / "pano_mvs_sky")
    given = parser.parse_args(arguments)
    print("| place | found, worst % | mean | lost, worst % | mean | confirmed without % |\n" + "|---" * 6 + "|")
    for place, settings in PLACES:
        if given.place is None or place in given.place:
            print(line(place, settings, scratch=given.scratch, width=given.width), flush=True)


if __name__ == "__main__":
    cv2.setNumThreads(1)
    main()
