"""What each mechanism of the dense stages is worth.

Runs the dense stages of a workflow with known poses, as they are and with each mechanism of `mechanisms.py` switched
off, on synthetic places, on captures with truth, and on real ones with a COLMAP model (`--data DIR`, repeatable).
Prints what each mechanism gains: with it minus without it. All views are scored:

* δ: pixels of the last map within 5 % of the truth;
* kept: share of pixels kept, in the order of confidence after the consistency check, at a precision of 95 %;
* F: F-score of the confirmed pixels within 1 % of the truth;
* score: the mean of these three; confirmed pixels, and their δ;
* cloud: F-score of the fused cloud within 1 % of the median true range;
* nothing: share of the pixels without any surface (the sky, a tripod) that have a range, so less is better;
* lost: share of the pixels with a surface that have no range in the end, so less is better.

Real captures have no true ranges: confirmed pixels, pixels with a range, and thickness and completeness of the cloud
are compared there. `--setting "depth.p1=40 depth.p2=600"` (repeatable) measures settings instead of mechanisms.

Every result is stored at once in `--results FILE`, by the settings, the wiring and the code of all stages, so that an
interrupted run continues, and a run after a change of the code measures only what it changes.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from pano_mvs.core.digest import digest_from_value
from pano_mvs.scene import RangeMap, Record
from tools.benchmarks.captures import SCRATCH
from tools.benchmarks.dense_chain import DenseChain
from tools.benchmarks.depth.mechanisms import FULL, MECHANISMS, Mechanism
from tools.benchmarks.depth.places import MASKS, Place, masked, places_of
from tools.benchmarks.depth.scores import Figures, figures_of, score
from tools.benchmarks.table import print_table

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
Row = Sequence[object]


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

    def measure(self, places: Sequence[Place], mechanisms: Sequence[Mechanism]) -> Table:
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
                workflow = mechanism.workflow(self.workflow, self.scratch / "workflows")
                chain = DenseChain(workflow, overrides=mechanism.settings.split(), memory=memory)
                key = _key(chain, place, mechanism)
                if key not in known:
                    known[key] = _measured(chain, place, mechanism, scratch=self.scratch)
                    self._store(known)
                found[mechanism.name][place.name] = known[key]
        return found

    def _store(self, known: Mapping[str, Figures]) -> None:
        self.results.parent.mkdir(parents=True, exist_ok=True)
        part = self.results.with_suffix(".part")
        part.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
        part.replace(self.results)


def _key(chain: DenseChain, place: Place, mechanism: Mechanism) -> str:
    """Return all that figures depend on."""
    others = [name for name in chain.stages if name == "cloud" or (place.has_rig and name in MASKS)]
    constants = [[name, value] for name, value in sorted(mechanism.constants.items())]
    parts = [chain.key(), constants, mechanism.drops_uncertainty, *(chain.settings(name) for name in others)]
    return f"{place.key} {mechanism.name} {digest_from_value(parts)[:16]}"


def _measured(chain: DenseChain, place: Place, mechanism: Mechanism, *, scratch: Path) -> Figures:
    """Return the figures of one mechanism on one place."""
    capture = place.capture(scratch)
    started = time.process_time()
    with mechanism.changed_constants(), tempfile.TemporaryDirectory() as folder:
        if place.has_rig:
            capture = masked(capture, chain, folder=Path(folder))
        # Results that depend on constants or on other masks are not those of other mechanisms.
        changed = (
            f"{place.key} {sorted(mechanism.constants.items())} {mechanism.name if mechanism.needs == 'rig' else ''}"
        )
        run = chain.run(capture, label=changed)
        fusing = replace(run, results=_without_uncertainty(run.results)) if mechanism.drops_uncertainty else run
        figures = figures_of(capture, run, chain.fused(capture, fusing))
    return {**figures, "cpu_s": time.process_time() - started}


def _without_uncertainty(results: Mapping[str, Mapping[str, Record]]) -> dict[str, dict[str, Record]]:
    return {
        stage: {
            name: replace(item, uncertainty=None) if isinstance(item, RangeMap) else item
            for name, item in items.items()
        }
        for stage, items in results.items()
    }


def gains(full: Mapping[str, Figures], without: Mapping[str, Figures], column: str, *, sign: int) -> dict[str, float]:
    """Return what each place gains in one column; places that do not have it are left out."""

    def value(figures: Figures) -> float:
        return score(figures) if column == "score" else figures.get(column, np.nan)

    found = {place: sign * (value(full[place]) - value(figures)) for place, figures in without.items()}
    return {place: gain for place, gain in found.items() if np.isfinite(gain)}


def synthetic_rows(found: Table, mechanisms: Sequence[Mechanism]) -> Iterator[Row]:
    """Yield the mean gains of each mechanism on the places with truth."""
    for one in mechanisms:
        sign = 1 if one.is_default else -1
        by_column = {column: gains(found[FULL.name], found[one.name], column, sign=sign) for column in COLUMNS}
        scores = by_column["score"]
        if not scores:
            continue
        cells = [f"{np.mean(list(by.values())):+.2f}" if by else "–" for by in by_column.values()]
        wins = f"{sum(gain > 0 for gain in scores.values())} of {len(scores)}"
        ends = [choose(scores, key=lambda place: scores[place]) for choose in (max, min)]
        yield one.item, _named(one), *cells, wins, *(f"{scores[place]:+.1f} {place}" for place in ends)


def place_rows(found: Table, mechanisms: Sequence[Mechanism], places: Sequence[str]) -> Iterator[Row]:
    """Yield the score of the workflow, and the gains in score of each mechanism, on each place with truth."""
    full = found[FULL.name]
    yield "score of the workflow", *(f"{score(full[place]):.1f}" for place in places)
    for one in mechanisms:
        by_place = gains(full, found[one.name], "score", sign=1 if one.is_default else -1)
        yield _named(one), *(f"{by_place[place]:+.1f}" if place in by_place else "" for place in places)


def real_rows(found: Table, mechanisms: Sequence[Mechanism], place: str) -> Iterator[Row]:
    """Yield the figures of a place without truth: without each mechanism, or with one that is not a default."""
    for one in (FULL, *mechanisms):
        if place in found[one.name]:
            figures = found[one.name][place]
            cells = [f"{figures[column]:.{4 if column == 'thickness' else 1}f}" for column in REAL_COLUMNS]
            name = one.name if one is FULL else f"{'without' if one.is_default else 'with'} {one.name}"
            yield name, *cells, f"{figures['cpu_s']:.1f}"


def _named(one: Mechanism) -> str:
    return one.name if one.is_default else f"{one.name} (not a default)"


def main(
    workflow: str = "quality",
    data: list[Path] | None = None,
    width: int = 512,
    mechanism: list[str] | None = None,
    setting: list[str] | None = None,
    place: list[str] | None = None,
    scratch: Path = SCRATCH / "ablation",
    results: Path | None = None,
) -> None:
    """Measure what is not known yet, and print the tables.

    Args:
        workflow: preset or file.
        data: captures with truth or colmap/.
        width: of the captures given by `data`.
        mechanism: only those whose names contain it.
        setting: measured instead of the mechanisms.
        place: only places whose names begin so.
        scratch: folder of rendered images.
        results: file of the figures; by default in the scratch folder.
    """
    cv2.setNumThreads(1)
    places = [one for one in places_of(data or (), width=width) if one.name.startswith(tuple(place or [""]))]
    chosen = [one for one in MECHANISMS if any(part in one.name for part in mechanism or [""])]
    if setting:
        chosen = [Mechanism("", one, one, is_default=False) for one in setting]
    found = Ablation(workflow, scratch, results or scratch / "figures.json").measure(places, chosen)
    known = [name for name, figures in found[FULL.name].items() if np.isfinite(score(figures))]
    print_table(["item", "mechanism", *COLUMNS.values(), "wins", "most", "least"], synthetic_rows(found, chosen))
    print()
    print_table(["mechanism", *known], place_rows(found, chosen, known))
    for name in found[FULL.name]:
        if name not in known:
            print()
            print_table([name, *REAL_COLUMNS.values(), "CPU-s"], real_rows(found, chosen, name))
