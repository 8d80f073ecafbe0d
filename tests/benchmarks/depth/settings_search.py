"""Choose the settings of the dense stages by search: `python -m tests.benchmarks.depth.settings_search`.

Runs the dense stages of a workflow (`--workflow`, default quality) with true poses on synthetic places of every kind
and on captures with truth (`--data DIR`, repeatable), with the defaults and with each setting of a list, and prints
what each setting is worth. `--setting "depth.p1=40 depth.p2=600"` (repeatable) replaces the list. Pictures are 320 to
512 columns wide, with 2 to 8 sources; the first two views of each place are scored (`place_scores.py`):

* δ: pixels of the last map within 5 % of the truth;
* kept: share of pixels kept, in the order of confidence after the consistency check, at a precision of 95 %;
* F: F-score of the confirmed pixels within 1 % of the truth.

The score is the mean of the three, in percent of the solid angle. Gains are means over places; captures of the same
place count as one. A setting is chosen if, for each place, the mean of the other places wins and the place itself loses
at most 0.3 points.

Scores are stored in `--results FILE` by the settings and the code of all dense stages, so that runs add up and a change
of the code is measured anew. To compare a change of the code, run the script on both checkouts with the same file and
different `--label NAME`, then add `--against NAME`: the same setting is then compared with its scores under that label.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from tests.benchmarks.depth.choice import left_out_gain, worth_of
from tests.benchmarks.depth.place_scores import PlaceScores, score_place
from tests.benchmarks.depth.places import Place, places_of
from tests.benchmarks.depth.stored_chain import StoredChain

REFERENCES = 2
DEFAULTS = ""
# One at a time around the defaults, then combinations.
SETTINGS = (
    "depth.p1=40 depth.p2=600",
    "depth.p1=20 depth.p2=300",
    "depth.combination=best_k depth.best=2",
    "depth.combination=best_k depth.best=3",
    "depth.combination=parallax_weighted",
    "depth.cost=census",
    "depth.window=5",
    "depth.window=9",
    "depth.support=3",
    "depth.planes=96",
    "depth.planes=192",
    "depth.p2_contrast=8",
    "depth.p2_contrast=30",
    "slanted.rounds=2",
    "slanted.window=7",
    "slanted.prior_px=0.3",
    "slanted.prior_px=1.2",
    "slanted.sigma_color=12",
    "checked.min_support=0.5",
    "checked.min_support=1.0",
    "checked.min_views=2",
    "checked.max_relative_error=0.01",
    "checked.max_reprojection_px=1.5",
    "smooth.smoothness=0.3",
    "smooth.smoothness=3",
    "smooth.sigma_luma=4",
    "planes.contrast=5",
    "planes.contrast=12",
    "planes.min_area_deg2=30",
    "planes.min_share=0.15",
    "planes.min_share=0.4",
    "planes.max_relative_error=0.03",
)
HEADER = (
    "| setting | score | ± | δ | kept | F | confirmed % | its δ | places that win | most | least | chosen |\n"
    + "|---" * 12
    + "|"
)

Table = dict[str, PlaceScores]


class Search:
    """Scores of settings on places, which are measured once."""

    def __init__(self, workflow: str, places: Sequence[Place], *, scratch: Path, results: Path, label: str) -> None:
        self.workflow, self.places, self.label = workflow, places, label
        self.scratch, self.results = scratch, results
        self.known: dict[str, dict[str, object]] = (
            json.loads(results.read_text(encoding="utf-8")) if results.is_file() else {}
        )

    def scores(self, setting: str) -> Table:
        """Return the scores of a setting, by name of the capture."""
        chain = StoredChain(self.workflow, overrides=setting.split(), store=self.scratch / "maps")
        code = chain.key()
        table: Table = {}
        for place in self.places:
            key = f"{place.key} {code}"
            if key not in self.known:
                scores = measure(chain, place, self.scratch)
                self._add(
                    key,
                    {"place": place.name, "setting": setting, "label": self.label, "workflow": self.workflow},
                    scores,
                )
            stored = {name: self.known[key][name] for name in _FIELDS}
            table[place.name] = PlaceScores(**stored)  # type: ignore[arg-type]
        return table

    def labelled(self, setting: str, label: str) -> Table:
        """Return the stored scores of a setting under another label, such as those of another checkout."""
        wanted = {place.name for place in self.places}
        return {
            str(entry["place"]): PlaceScores(**{name: entry[name] for name in _FIELDS})  # type: ignore[arg-type]
            for entry in self.known.values()
            if (entry["setting"], entry["label"], entry.get("workflow")) == (setting, label, self.workflow)
            and entry["place"] in wanted
        }

    def _add(self, key: str, what: Mapping[str, str], scores: PlaceScores) -> None:
        """Store scores; those that another run has stored in the meantime stay."""
        if self.results.is_file():
            self.known = json.loads(self.results.read_text(encoding="utf-8")) | self.known
        self.known[key] = {**what, **dataclasses.asdict(scores)}
        self.results.parent.mkdir(parents=True, exist_ok=True)
        self.results.write_text(json.dumps(self.known, indent=1) + "\n", encoding="utf-8")


_FIELDS = tuple(field.name for field in dataclasses.fields(PlaceScores))


def measure(chain: StoredChain, place: Place, scratch: Path) -> PlaceScores:
    """Return the scores of a workflow on a place."""
    capture = place.capture(scratch)
    references = list(capture.panoramas)[:REFERENCES]
    run = chain.run(capture, label=place.key, references=references)
    maps = run.range_maps
    return score_place(
        [maps["checked"][name] for name in references],
        [list(maps.values())[-1][name] for name in references],
        [capture.ranges[name] for name in references],
        cpu_s=sum(run.cpu_s.values()),
    )


def by_place(table: Table, figure: str) -> dict[str, float]:
    """Return one figure of each place, the mean over its captures."""
    values: dict[str, list[float]] = defaultdict(list)
    for name, scores in table.items():
        values[name.rsplit("-", 2)[0]].append(getattr(scores, figure))
    return {place: float(np.mean(found)) for place, found in values.items()}


def line(setting: str, default: Table, table: Table) -> str:
    """Return one row of the table of settings: gains."""
    default = {name: scores for name, scores in default.items() if name in table}
    worth = worth_of(by_place(default, "score"), by_place(table, "score"))
    gains = [
        worth_of(by_place(default, figure), by_place(table, figure)).mean
        for figure in ("delta", "kept", "surface_f", "confirmed", "confirmed_delta")
    ]
    cells = [
        f"`{setting}`",
        f"{worth.mean:+.2f}",
        f"{worth.error:.2f}",
        *(f"{gain:+.2f}" for gain in gains),
        f"{worth.winners} of {len(worth.gains)}",
        *(f"{worth.gains[place]:+.1f} {place}" for place in (worth.best, worth.worst)),
        "yes" if worth.is_chosen else "",
    ]
    return "| " + " | ".join(cells) + " |"


def place_lines(table: Table) -> Iterator[str]:
    """Return the scores of each capture."""
    yield "| capture | score | δ | kept | F | confirmed % | its δ | CPU s |\n" + "|---" * 8 + "|"
    for name, scores in table.items():
        figures = [scores.score, *(getattr(scores, field) for field in _FIELDS)]
        yield f"| {name} | " + " | ".join(f"{figure:.1f}" for figure in figures) + " |"


def main() -> None:
    """Measure what is not known yet, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workflow", default="quality")
    parser.add_argument("--data", action="append", default=[], type=Path, metavar="DIR", help="captures with truth")
    parser.add_argument("--setting", action="append", metavar="'STAGE.PARAM=VALUE …'", help="only these; '' is none")
    parser.add_argument("--place", action="append", metavar="NAME", help="only captures whose names begin so")
    scratch = Path(tempfile.gettempdir()) / "pano_mvs_settings_search"
    parser.add_argument("--scratch", type=Path, default=scratch, help="folder of rendered pictures and stored maps")
    parser.add_argument("--results", type=Path, help="file of the scores; default: in the scratch folder")
    parser.add_argument("--label", default="", help="name of this checkout in the file of the scores")
    parser.add_argument("--against", metavar="LABEL", help="compare with the scores under this label")
    given = parser.parse_args()
    places = [
        place for place in places_of(given.data) if given.place is None or place.name.startswith(tuple(given.place))
    ]
    results = given.results or given.scratch / "scores.json"
    search = Search(given.workflow, places, scratch=given.scratch, results=results, label=given.label)
    default = search.scores(DEFAULTS)
    print("\n".join(place_lines(default)), flush=True)
    print(f"\n{HEADER}")
    worths = {}
    for setting in SETTINGS if given.setting is None and not given.against else given.setting or [DEFAULTS]:
        before = default if given.against is None else search.labelled(setting, given.against)
        table = search.scores(setting)
        worths[setting] = worth_of(by_place(before, "score"), by_place(table, "score"))
        print(line(setting, before, table), flush=True)
    print(f"\nChosen without the place that is scored: {left_out_gain(worths):+.2f} on the mean of the places.")


if __name__ == "__main__":
    main()
