"""Measure how many small faults in the code the tests notice.

The faults are put into the code one at a time, and some test has to notice each. Each group's score is that of a sample
of its faults, the same each time. Each fault is printed with its id and what came of it.
"""

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from tools.mutation.equivalent import EQUIVALENT
from tools.mutation.groups import GROUPS, Group
from tools.mutation.mutants import Mutant, mutants_of
from tools.mutation.trial import Baseline, copy_tree, measure, outcome_of

ROOT = Path(__file__).resolve().parents[2]


def main() -> None:
    """Run the faults of some groups and print the scores."""
    parser = argparse.ArgumentParser(description=__doc__)
    listed = f"of {', '.join(GROUPS)}; all if none is named"
    parser.add_argument("group", nargs="*", choices=[[], *GROUPS], metavar="GROUP", help=listed)
    parser.add_argument("--sample", type=int, default=60, help="faults per group; 0 for all")
    parser.add_argument("--skip", type=int, default=0, help="another sample: the faults after so many")
    parser.add_argument("--ids", nargs="+", default=(), help="only these faults")
    parser.add_argument("--tests", nargs="+", default=(), help="these tests instead of the group's")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mutation-") as name:
        tree = Path(name).resolve()
        copy_tree(ROOT, tree)
        known: dict[Sequence[str], Baseline] = {}
        sources = [source for group in GROUPS.values() for source in group.sources]
        for title in arguments.group or GROUPS:
            group = GROUPS[title]
            tests = tuple(arguments.tests) or group.tests
            if tests not in known:
                known[tests] = measure(tree, sources, tests)
            chosen = _chosen(tree, group, arguments)
            _report(title, _tried(tree, chosen, known[tests]))


def _chosen(tree: Path, group: Group, arguments: argparse.Namespace) -> list[Mutant]:
    """Return the faults with the smallest ids, which are digests, so that other faults do not change the sample."""
    paths = [path for one in group.sources for path in sorted(tree.glob(one)) if path.name != "__init__.py"]
    mutants = [one for path in paths for one in mutants_of(path.relative_to(tree).as_posix(), path.read_text("utf-8"))]
    mutants = [one for one in mutants if not group.within or one.where.partition(".")[0] == group.within]
    if arguments.ids:
        return [one for one in mutants if one.id in arguments.ids]
    first, number = arguments.skip, arguments.sample or len(mutants)
    chosen = sorted(mutants, key=lambda one: one.id)[first : first + number]
    return sorted(chosen, key=lambda one: (one.path, one.lines))


def _tried(tree: Path, mutants: Sequence[Mutant], baseline: Baseline) -> Counter[str]:
    counts: Counter[str] = Counter()
    for mutant in mutants:
        begun = time.perf_counter()
        outcome = outcome_of(tree, mutant, baseline)
        if outcome in ("survived", "uncovered") and mutant.id in EQUIVALENT:
            outcome = "equivalent"
        counts[outcome] += 1
        line = f"{mutant.id} {outcome:10} {mutant.path}:{mutant.lines[0]} {mutant.where}: {mutant.what}"
        print(f"{time.perf_counter() - begun:5.1f} s {line[:230]}", flush=True)
    return counts


def _report(title: str, counts: Counter[str]) -> None:
    noticed = counts["killed"] + counts["timeout"]
    total = counts.total() - counts["equivalent"]
    listed = ", ".join(f"{number} {outcome}" for outcome, number in sorted(counts.items()))
    print(f"{title}: {100 * noticed / max(total, 1):.1f} % of {total} faults noticed ({listed})", flush=True)
