"""Values that say of themselves what is doubtful: run, cached run, and which stage's word counts."""

from __future__ import annotations

import pytest

from tests.engine.conftest import Toy, settle

GUESSES = '''

@dataclass(frozen=True, eq=False)
class Guess(Record):
    """A collection that doubts some of its items."""
    doubts: dict[str, str]

    def doubted(self):
        return self.doubts


class GuessParams(Params):
    doubts: dict[str, str] = {}


@stage("toy.guess")
def guess(xs: All[Number], params: GuessParams) -> Guess:
    """Doubt what the settings say."""
    return Guess(params.doubts)


@stage("toy.guess_again")
def guess_again(guess: One[Guess], params: GuessParams) -> Guess:
    """Doubt what the settings say."""
    return Guess(params.doubts)


@stage("toy.count_doubts")
def count_doubts(guess: One[Guess], ctx: Context) -> Files:
    """Write the number of doubts."""
    path = ctx.scratch / "count.txt"
    path.write_text(str(len(guess.doubts)))
    return Files({"count.txt": path})
'''

WORKFLOW = """\
pano_mvs: 1
name: guesses
plugins: [plug.py]
stages:
  images: {use: toy.source, path: capture}
  first:  {use: toy.guess}
  second: {use: toy.guess_again}
  count:  {use: toy.count_doubts}
"""


@pytest.fixture
def guesses(toy: Toy) -> Toy:
    for name, text in (("plug.py", (toy.folder / "plug.py").read_text() + GUESSES), ("wf.yaml", WORKFLOW)):
        (toy.folder / name).write_text(text)
        settle(toy.folder / name)
    return toy


def test_a_doubt_ends_with_code_3_and_a_cached_run_says_it_again(guesses: Toy) -> None:
    doubt = "second.doubts={2.txt: odd}"
    for computed in (8, 0):
        result = guesses.run(doubt)
        assert (result.computed, result.exit_code, result.stopped) == (computed, 3, "")
        assert result.doubts == {"2.txt": ("second", "odd")}
        assert not result.failures


def test_the_last_value_of_a_kind_decides(guesses: Toy) -> None:
    first = "first.doubts={2.txt: odd, 3.txt: dark}"
    passed_on = guesses.run(first, "second.doubts={2.txt: odd}")
    assert passed_on.doubts == {"2.txt": ("second", "odd")}
    cleared = guesses.run(first)
    assert (cleared.exit_code, cleared.doubts) == (0, {})


def test_a_doubt_of_a_value_that_nothing_replaces_counts_whatever_else_reads_it(guesses: Toy) -> None:
    (guesses.folder / "wf.yaml").write_text(WORKFLOW.replace("  second: {use: toy.guess_again}\n", ""))
    result = guesses.run("first.doubts={2.txt: odd}")
    assert (result.exit_code, result.doubts) == (3, {"2.txt": ("first", "odd")})


def test_files_of_an_earlier_run_go_though_something_is_doubtful(guesses: Toy) -> None:
    earlier = dict(guesses.run("count.to=here").published)
    result = guesses.run("count.to=there", "second.doubts={2.txt: odd}", earlier=earlier)
    assert (result.exit_code, result.removed) == (3, ["here/count.txt"])
