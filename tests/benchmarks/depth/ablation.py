"""What each mechanism of the dense stages is worth: `python -m tests.benchmarks.depth.ablation [--data DIR …]`.

Runs the dense stages of a workflow (`--workflow`, default quality) with known poses, as they are and with each
mechanism of `mechanisms.py` switched off, on synthetic places, on captures with truth, and on real ones with a COLMAP
model (`--data DIR`, repeatable). Prints what each mechanism gains: with it minus without it. All views are scored:

* δ, kept, F, confirmed and its δ, as in `settings_search`, and their score, the mean of the first three;
* cloud: F-score of the fused cloud within 1 % of the median true range;
* nothing: share of the pixels without any surface (the sky, a tripod) that have a range, so less is better;
* lost: share of the pixels with a surface that have no range in the end, so less is better.

Real captures have no true ranges: confirmed pixels, pixels with a range, and thickness and completeness of the cloud
(`walls.py`) are compared there.

Every result is stored at once in `--results FILE`, by the settings, the wiring and the code of all stages, so that an
interrupted run continues, and a run after a change of the code measures only what it changes.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pano_mvs.core.digest import digest_from_value
from pano_mvs.scene import Record
from tests.benchmarks.depth.ablation_places import MASKS, AblationPlace, ablation_places, masked
from tests.benchmarks.depth.ablation_scores import Figures, figures_of
from tests.benchmarks.depth.mechanisms import FULL, MECHANISMS, Mechanism
from tests.benchmarks.depth.stored_chain import StoredChain

_SCORES = ("delta", "kept", "surface_f")
COLUMNS = {
    "score": "score",
    "delta": "δ",
    "kept": "kept",
    "surface_f": "F",
    "cloud_f": "cloud",
    "confirmed": "confirmed",
    "confirmed_delta": "its δ",
    "nothing": "nothing",
    "lost": "lost",
}
REAL_COLUMNS = {
    "confirmed": "confirmed %",
    "valid": "with a range %",
    "thickness": "thickness, baselines",
    "cloud_complete": "complete %",
}


Table = dict[str, dict[str, Figures]]
"""Figures by mechanism and place."""


@dataclass
class Ablation:
    """Figures of mechanisms on places, which are measured once.

    Attributes:
        workflow: a preset or file.
        scratch: folder for rendered images and files.
        results: file of the figures.
    """

    workflow: str
    scratch: Path
    results: Path

    def measure(
        self, places: Sequence[AblationPlace], mechanisms: Sequence[Mechanism]
    ) -> dict[str, dict[str, Figures]]:
        """Return the figures by mechanism and place; what is not known yet is measured and stored."""
        known: dict[str, Figures] = (
            json.loads(self.results.read_text(encoding="utf-8")) if self.results.is_file() else {}
        )
        found: Table = {mechanism.name: {} for mechanism in (FULL, *mechanisms)}
        for place in places:
            memory: dict[str, Record] = {}
            for mechanism in (FULL, *mechanisms):
                if mechanism is not FULL and not place.is_for(mechanism.needs):
                    continue
                chain = self._chain(mechanism, memory)
                key = _key(chain, place, mechanism)
                if key not in known:
                    known[key] = _measured(chain, place, mechanism, scratch=self.scratch)
                    self._store(known)
                found[mechanism.name][place.name] = known[key]
        return found

    def _chain(self, mechanism: Mechanism, memory: dict[str, Record]) -> StoredChain:
        workflow = mechanism.workflow(self.workflow, self.scratch / "workflows")
        return StoredChain(workflow, overrides=mechanism.settings.split(), memory=memory)

    def _store(self, known: Mapping[str, Figures]) -> None:
        self.results.parent.mkdir(parents=True, exist_ok=True)
        part = self.results.with_suffix(".part")
        part.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
        part.replace(self.results)


def _key(chain: StoredChain, place: AblationPlace, mechanism: Mechanism) -> str:
    """Return all that figures depend on."""
    others = [name for name in chain.chain.stages if name == "cloud" or (place.has_rig and name in MASKS)]
    constants = [[name, value] for name, value in sorted(mechanism.constants.items())]
    parts = [chain.key(), constants, mechanism.drops_uncertainty, *(chain.settings(name) for name in others)]
    return f"{place.key} {mechanism.name} {digest_from_value(parts)[:16]}"


def _measured(chain: StoredChain, place: AblationPlace, mechanism: Mechanism, *, scratch: Path) -> Figures:
    """Return the figures of one mechanism on one place."""
    capture = place.capture(scratch)
    started = time.process_time()
    with mechanism.changed_constants(), tempfile.TemporaryDirectory() as folder:
        if place.has_rig:
            capture = masked(capture, chain.chain, folder=Path(folder))
        # Results that depend on constants or on other masks are not those of other mechanisms.
        changed = (
            f"{place.key} {sorted(mechanism.constants.items())} {mechanism.name if mechanism.needs == 'rig' else ''}"
        )
        run = chain.run(capture, label=changed, references=list(capture.panoramas))
        figures = figures_of(capture, run, chain.chain, drops_uncertainty=mechanism.drops_uncertainty)
    return {**figures, "cpu_s": time.process_time() - started}


def score(figures: Figures) -> float:
    """Return the mean of δ, kept and F; NaN without truth."""
    return float(np.mean([figures.get(name, np.nan) for name in _SCORES]))


def gains(full: Mapping[str, Figures], without: Mapping[str, Figures], column: str, *, sign: int) -> dict[str, float]:
    """Return what each place gains in one column; places that do not have it are left out."""

    def value(figures: Figures) -> float:
        return score(figures) if column == "score" else figures.get(column, np.nan)

    found = {place: sign * (value(full[place]) - value(figures)) for place, figures in without.items()}
    return {place: gain for place, gain in found.items() if np.isfinite(gain)}


def synthetic_lines(found: Table, mechanisms: Sequence[Mechanism]) -> Iterator[str]:
    """Return the table of mean gains on the places with truth."""
    yield "| item | mechanism | " + " | ".join(COLUMNS.values()) + " | wins | most | least |"
    yield "|---" * (len(COLUMNS) + 5) + "|"
    full = found[FULL.name]
    for one in mechanisms:
        sign = 1 if one.is_default else -1
        by_column = {column: gains(full, found[one.name], column, sign=sign) for column in COLUMNS}
        scores = by_column["score"]
        if not scores:
            continue
        cells = [f"{np.mean(list(by.values())):+.2f}" if by else "–" for by in by_column.values()]
        best, worst = (choose(scores, key=lambda place: scores[place]) for choose in (max, min))
        wins = f"{sum(gain > 0 for gain in scores.values())} of {len(scores)}"
        ends = [f"{scores[place]:+.1f} {place}" for place in (best, worst)]
        yield f"| {one.item} | {_named(one)} | " + " | ".join([*cells, wins, *ends]) + " |"


def place_lines(found: Table, mechanisms: Sequence[Mechanism]) -> Iterator[str]:
    """Return the table of the gains in score of each mechanism on each place with truth."""
    full = found[FULL.name]
    places = [place for place, figures in full.items() if np.isfinite(score(figures))]
    yield "| mechanism | " + " | ".join(places) + " |\n" + "|---" * (len(places) + 1) + "|"
    yield "| score of the workflow | " + " | ".join(f"{score(full[place]):.1f}" for place in places) + " |"
    for one in mechanisms:
        by_place = gains(full, found[one.name], "score", sign=1 if one.is_default else -1)
        cells = [f"{by_place[place]:+.1f}" if place in by_place else "" for place in places]
        yield f"| {_named(one)} | " + " | ".join(cells) + " |"


def real_lines(found: Table, mechanisms: Sequence[Mechanism]) -> Iterator[str]:
    """Return a table for each place without truth: figures without each mechanism, or with one that is no default."""
    for place, whole in found[FULL.name].items():
        if np.isfinite(score(whole)):
            continue
        yield f"\n| {place} | " + " | ".join(REAL_COLUMNS.values()) + " | CPU-s |\n" + "|---" * 6 + "|"
        for one in (FULL, *mechanisms):
            if place in found[one.name]:
                figures = found[one.name][place]
                digits = {column: 4 if column == "thickness" else 1 for column in REAL_COLUMNS}
                cells = [f"{figures[column]:.{digits[column]}f}" for column in REAL_COLUMNS]
                name = one.name if one is FULL else f"{'without' if one.is_default else 'with'} {one.name}"
                yield f"| {name} | " + " | ".join(cells) + f" | {figures['cpu_s']:.1f} |"


def _named(one: Mechanism) -> str:
    return one.name if one.is_default else f"{one.name} (not a default)"


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure what is not known yet, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workflow", default="quality")
    parser.add_argument("--data", action="append", default=[], type=Path, metavar="DIR", help="with truth or colmap/")
    parser.add_argument("--width", type=int, default=512, help="of the captures given by --data")
    parser.add_argument("--mechanism", action="append", metavar="NAME", help="only those whose names contain it")
    parser.add_argument("--place", action="append", metavar="NAME", help="only places whose names begin so")
    scratch = Path(tempfile.gettempdir()) / "pano_mvs_ablation"
    parser.add_argument("--scratch", type=Path, default=scratch, help="folder of rendered images")
    parser.add_argument("--results", type=Path, help="file of the figures; default: in the scratch folder")
    given = parser.parse_args(arguments)
    places = [
        place
        for place in ablation_places(given.data, width=given.width)
        if given.place is None or place.name.startswith(tuple(given.place))
    ]
    chosen = [one for one in MECHANISMS if given.mechanism is None or any(part in one.name for part in given.mechanism)]
    ablation = Ablation(given.workflow, given.scratch, given.results or given.scratch / "figures.json")
    found = ablation.measure(places, chosen)
    for lines in (synthetic_lines, place_lines, real_lines):
        print("\n".join(lines(found, chosen)) + "\n", flush=True)


if __name__ == "__main__":
    cv2.setNumThreads(1)
    main()
