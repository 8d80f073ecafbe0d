"""How long each extractor takes.

On the synthetic room with its strong texture, rendered at three sizes. "cold" is the first call at a size, which builds
SPHORB's grid (and, at the first size, compiles its kernels or loads them); "warm" the median of those that follow.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import cv2
import numpy as np

from pano_mvs.algorithms.features.sphorb import extract_sphorb
from pano_mvs.algorithms.features.tangent import extract_orb, extract_sift
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features
from pano_mvs.testing.room import default_room, render

WIDTHS = (1024, 1280, 2048)
KEYPOINTS = 10_000
LIMIT_S = 1.5  # SPHORB at 640 × 1280, warm, one core
EXTRACTORS: dict[str, Callable[..., Features]] = {"sift": extract_sift, "orb": extract_orb, "sphorb": extract_sphorb}


def main(runs: int = 5) -> None:
    """Print seconds and key points for each size and extractor."""
    cv2.setNumThreads(1)
    for width in WIDTHS:
        image = render(default_room(), Rigid3.identity(), (width // 2, width), supersample=1)[0]
        mask = np.ones(image.shape[:2], np.bool_)
        for name, extract in EXTRACTORS.items():
            seconds = []
            for _ in range(runs + 1):
                start = time.perf_counter()
                count = len(extract(image, mask, max_keypoints=KEYPOINTS))
                seconds.append(time.perf_counter() - start)
            warm = statistics.median(seconds[1:])
            print(
                f"{width // 2:4d} × {width}  {name:7s} cold {seconds[0]:.2f} s  warm {warm:.2f} s  {count} key points"
            )
    print(f"limit: sphorb {LIMIT_S} s warm at 640 × 1280")
