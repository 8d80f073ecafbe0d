"""What the corrections of `poses.verify` do to the cameras of generated captures.

Captures of `families` are matched, solved as users solve them, and given to `verify_poses` with their key points and
pairs. For each family the table shows the cameras with truth, those that are right (within 1° and 2 % of the extent)
before and after the correction, and after it those that are wrong and not doubted, and right but doubted; then the CPU
seconds of `verify_poses`. Below it are the captures that lost a camera that was right: moved, left out, or no longer in
the largest part that is right.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.poses.verification.confirmation import Picture
from pano_mvs.algorithms.poses.verification.verify_poses import verify_poses
from pano_mvs.scene import Features, TwoView
from tools.benchmarks.belief.families import FAMILIES, LEARNED, Capture, draw
from tools.benchmarks.belief.measuring import matched
from tools.benchmarks.poses.placements import Placements, judge_placements
from tools.benchmarks.table import print_table

COLUMNS = (
    "family", "captures", "cameras", "right before", "right after", "wrong, not doubted", "right, doubted", "CPU-s",
)  # fmt: skip


@dataclass(frozen=True)
class Corrected:
    """One capture before and after the correction.

    Attributes:
        family: of the capture.
        seed: of the capture.
        before: how its cameras were solved.
        after: how they were corrected.
        cpu_s: CPU seconds of `verify_poses`.
    """

    family: str
    seed: int
    before: Placements
    after: Placements
    cpu_s: float

    @property
    def lost(self) -> list[str]:
        """Names of the cameras that were right and no longer are."""
        return sorted(_right(self.before) - _right(self.after))


def _right(placed: Placements) -> set[str]:
    return {name for name, right in zip(placed.names, placed.right, strict=True) if right}


def corrected(
    capture: Capture, features: Mapping[str, Features], two_views: Mapping[tuple[str, str], TwoView]
) -> Corrected:
    """Solve and correct a capture."""

    def load(name: str) -> Picture:
        return capture.pictures[name], np.ones(capture.pictures[name].shape[:2], np.bool_)

    solved = solve_scaled_translation(features, two_views, load=load, rng=np.random.default_rng(1))
    start = time.process_time()
    verified = verify_poses(solved, load, features=features, two_views=two_views)
    cpu_s = time.process_time() - start
    before, after = (judge_placements(poses, capture.truth) for poses in (solved, verified))
    return Corrected(capture.family, capture.seed, before, after, cpu_s)


def row(label: str, found: Sequence[Corrected]) -> list[object]:
    """Return the row of some captures."""
    return [
        label,
        len(found),
        sum(one.before.expected for one in found),
        sum(int(one.before.right.sum()) for one in found),
        sum(int(one.after.right.sum()) for one in found),
        sum(len(one.after.unreported) for one in found),
        sum(int((one.after.right & one.after.doubted).sum()) for one in found),
        f"{sum(one.cpu_s for one in found):.1f}",
    ]


def measure(families: Iterable[str], seeds: Sequence[int]) -> list[str]:
    """Print the table, and return what happened to single captures, in words."""
    every: list[Corrected] = []
    notes: list[str] = []

    def rows() -> Iterator[list[object]]:
        for family in families:
            found = []
            for seed in seeds:
                try:
                    capture = draw(family, seed)
                except ValueError as error:  # the drawn place is too small for its cameras
                    notes.append(f"{family} {seed} was not measured: {error}")
                    continue
                one = corrected(capture, *matched(capture, learned=family.endswith(LEARNED)))
                found.append(one)
                if one.lost:
                    notes.append(f"{family} {seed} lost {', '.join(one.lost)}")
            every.extend(found)
            yield row(family, found)
        yield row("all", every)

    print_table(COLUMNS, rows())
    return notes


def main() -> None:
    """Measure the captures that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--families", nargs="+", choices=list(FAMILIES), default=list(FAMILIES))
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=1, help="captures of each family; default 1")
    options = parser.parse_args()
    notes = measure(options.families, range(options.first_seed, options.first_seed + options.rounds))
    print("\n" + "\n".join(notes or ["No capture lost a camera that was right."]))
