"""Which stage feeds which port, in which order stages run, and which mistakes are found before anything runs."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest

from pano_mvs.core.errors import WorkflowError
from pano_mvs.engine.workflows.wiring import Graph, wire, wiring_problems
from pano_mvs.scene import Axis
from tests.engine.conftest import Toy

MORE = '''

@dataclass(frozen=True, eq=False)
class Total(Record):
    value: float


@stage("toy.total")
def total(xs: All[Number]) -> Total:
    """Sum."""
    return Total(sum(x.value for x in xs.values()))


@stage("toy.total_of_any")
def total_of_any(xs: All[Number] | None) -> Total:
    """Sum; of none without input."""
    return Total(sum(x.value for x in (xs or {}).values()))


@stage("toy.plus")
def plus(x: Each[Number], total: One[Total] | None) -> Number:
    """With the total, if there is one."""
    return Number(x.value)


@stage("toy.number_of_total")
def number_of_total(total: One[Total]) -> Number:
    """No axis fits."""
    return Number(total.value)


@stage("toy.total_of_each")
def total_of_each(x: Each[Number]) -> Total:
    """No axis fits."""
    return Total(x.value)


@stage("toy.change")
def change(difference: Each[Difference]) -> Difference:
    """One pair each."""
    return difference


@stage("toy.mixed")
def mixed(difference: Each[Difference], x: Each[Number]) -> Difference:
    """Pairs and images."""
    return difference


@stage("toy.each_total")
def each_total(total: Each[Total]) -> Number:
    """Nobody gives one total for each image."""
    return Number(0)


@stage("toy.view")
def view(mean: Each[Mean], x: Each[Number]) -> Mean:
    """One view each, with its image."""
    return mean


@stage("toy.around", every_image=True)
def around(x: Each[Number], near: Near[Number]) -> Number:
    """The number, plus a tenth of the sum of its own and those of its neighbours."""
    return Number(x.value + sum(other.value for other in near) / 10)


@stage("toy.after")
def after(files: One[Files]) -> Files:
    """Whatever has been written."""
    return files
'''
SOURCE = "  i: {use: toy.source, path: capture}\n"
SCALED = SOURCE + "  s: {use: toy.scale}\n"


Wire = Callable[[str], Graph]


@pytest.fixture
def wired(toy: Toy) -> Wire:
    """Returns the graph of the stages in a text."""
    toy.edit("plug.py", lambda text: text + MORE)

    def graph(stages: str) -> Graph:
        (toy.folder / "wf.yaml").write_text("pano_mvs: 1\nplugins: [plug.py]\nstages:\n" + stages)
        return toy.session().graph

    return graph


def producers(graph: Graph, name: str) -> dict[str, tuple[str, bool]]:
    return {port: (edge.producer, edge.exploded) for port, edge in graph.edges[name].items()}


def test_every_port_is_fed_and_every_stage_has_its_axis(toy: Toy) -> None:
    graph = toy.session().graph
    assert {name: producers(graph, name) for name in graph.order} == {
        "images": {},
        "scaled": {"x": ("images", False)},
        "pairs": {"names": ("scaled", False)},
        "difference": {"ends": ("scaled", False), "index": ("pairs", False)},
        "shifted": {"xs": ("scaled", False)},
        "views": {"names": ("images", False)},
        "mean": {"own": ("scaled", False), "around": ("scaled", False), "index": ("views", False)},
        "each": {"mean": ("mean", False)},
        "all": {"differences": ("difference", False), "shifted": ("shifted", False)},
    }
    assert graph.axes == {
        "images": Axis.IMAGE,
        "scaled": Axis.IMAGE,
        "pairs": Axis.ONE,
        "difference": Axis.PAIR,
        "shifted": Axis.ONE,
        "views": Axis.ONE,
        "mean": Axis.VIEW,
        "each": Axis.VIEW,
        "all": Axis.ONE,
    }
    assert graph.order == tuple(graph.axes)
    assert (graph.only, graph.is_part) == ({}, False)
    edge = graph.edges["mean"]["around"]
    assert str(edge.port) == "around: Near[Number]"


def test_stages_run_in_the_order_of_the_file_except_for_what_feeds_them(wired: Wire) -> None:
    graph = wired(
        "  z: {use: toy.scale, in: {x: y}}\n" + SOURCE + "  c: {use: toy.total, in: {xs: i}}\n"
        "  b: {use: toy.scale, in: {x: i}}\n  y: {use: toy.scale, in: {x: b}}\n  a: {use: toy.total, in: {xs: i}}\n"
    )
    assert graph.order == ("i", "c", "b", "y", "z", "a")


def test_a_part_of_a_graph_is_what_its_ends_need(toy: Toy) -> None:
    part = toy.session().graph.limited_to(["mean", "shifted"], {"mean": frozenset({"1.txt"})})
    assert part.order == ("images", "scaled", "shifted", "views", "mean")
    assert part.only == {"mean": frozenset({"1.txt"})}
    assert part.is_part
    assert toy.session().graph.limited_to(["pairs"], {}).order == ("images", "scaled", "pairs")


def test_a_port_that_may_stay_unconnected_does(wired: Wire) -> None:
    assert producers(wired(SOURCE + "  p: {use: toy.plus}\n"), "p") == {"x": ("i", False)}
    fed = wired(SOURCE + "  t: {use: toy.total}\n  p: {use: toy.plus}\n")
    assert producers(fed, "p") == {"x": ("i", False), "total": ("t", False)}
    assert fed.axes["p"] is Axis.IMAGE


def test_the_units_of_a_stage_are_those_of_its_finest_input(wired: Wire) -> None:
    head = SOURCE + "  s: {use: toy.scale}\n"
    pairs = wired(head + "  p: {use: toy.pairs}\n  d: {use: toy.difference}\n  c: {use: toy.change}\n")
    assert (pairs.axes["d"], pairs.axes["c"]) == (Axis.PAIR, Axis.PAIR)
    views = wired(head + "  v: {use: toy.views}\n  m: {use: toy.mean}\n  w: {use: toy.view, in: {x: s}}\n")
    assert (views.axes["m"], views.axes["w"]) == (Axis.VIEW, Axis.VIEW)
    exploded = wired(head + "  h: {use: toy.shifted}\n  b: {use: toy.scale, in: {x: h}}\n")
    assert (exploded.axes["h"], exploded.axes["b"]) == (Axis.ONE, Axis.IMAGE)
    assert producers(exploded, "b") == {"x": ("h", True)}


def test_a_whole_collection_feeds_a_port_that_wants_it_whole(wired: Wire) -> None:
    text = SOURCE + "  h: {use: toy.shifted}\n  d: {use: toy.total, in: {xs: h}}\n"
    assert producers(wired(text), "d") == {"xs": ("h", True)}
    text += "  p: {use: toy.pairs, in: {names: h}}\n  e: {use: toy.difference, in: {ends: i}}\n"
    assert producers(wired(text + "  w: {use: toy.write, in: {differences: e}}\n"), "w")["shifted"] == ("h", False)


def test_files_of_any_axis_feed_a_port_for_one(wired: Wire) -> None:
    means = "  v: {use: toy.views}\n  m: {use: toy.mean, in: {own: s, around: s}}\n"
    graph = wired(SCALED + means + "  w: {use: toy.write_each}\n  a: {use: toy.after}\n")
    assert producers(graph, "a") == {"files": ("w", False)}


def test_the_nearest_of_several_is_taken_if_it_depends_on_the_others(wired: Wire) -> None:
    """Also where it depends on them through stages in between."""
    graph = wired(
        SOURCE + "  a: {use: toy.scale}\n  h: {use: toy.shifted, in: {xs: a}}\n"
        "  b: {use: toy.scale, in: {x: h}}\n  c: {use: toy.total}\n"
    )
    assert producers(graph, "c") == {"xs": ("b", False)}


def test_a_value_that_another_stage_takes_by_name_is_no_candidate_beside_the_nearest(wired: Wire) -> None:
    """Regression: a stage in front of the refinement made presets ambiguous that solve poses twice."""
    side = SOURCE + "  a: {use: toy.scale}\n  t: {use: toy.total, in: {xs: a}}\n  b: {use: toy.scale, in: {x: i}}\n"
    assert producers(wired(side + "  c: {use: toy.total}\n"), "c") == {"xs": ("b", False)}
    assert producers(wired(side + "  d: {use: toy.scale}\n  c: {use: toy.total}\n"), "c") == {"xs": ("d", False)}


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        (
            SOURCE + "  t: {use: toy.total}\n  n: {use: toy.number_of_total}\n",
            "stage 'toy.number_of_total' returns Number (one per image), but its inputs give one unit per one",
        ),
        (
            SOURCE + "  t: {use: toy.total_of_each}\n",
            "stage 'toy.total_of_each' returns Total (one per one), but its inputs give one unit per image",
        ),
        (
            SCALED + "  p: {use: toy.pairs}\n  d: {use: toy.difference}\n  m: {use: toy.mixed, in: {x: s}}\n",
            "stage 'm' mixes Each inputs of pairs and of images",
        ),
        (
            SOURCE + "  t: {use: toy.total}\n  e: {use: toy.each_total}\n",
            "stage 'e' needs total: Each[Total], but no earlier stage produces Total",
        ),
        (
            SOURCE + "  p: {use: toy.pairs}\n  a: {use: toy.scale, in: {x: p}}\n",
            "port x: Each[Number] cannot be fed by 'p', which produces Pairs",
        ),
        ("  a: {use: toy.scale}\n" + SOURCE, "produces Number (i below does: move it up or name it in `in:`)"),
        (SOURCE + "  s: {use: toy.scale, in: {x: j}}\n", "port 'x': there is no stage 'j'; stages: i, s"),
        (SCALED + "  t: {use: toy.total, in: {xs: sss}}\n", "there is no stage 'sss'; did you mean 's'?"),
        (SOURCE + "  s: {use: toy.scale, in: {xx: i}}\n", "stage 's' has no port 'xx'; did you mean 'x'?"),
        ("  i: {use: toy.source, path: capture, in: {x: i}}\n", "stage 'i' has no port 'x'; its ports: none"),
        (SOURCE + "  d: {use: toy.difference, in: {ends: i}}\n", "needs an index index: One[Pairs], but"),
        (
            "  a: {use: toy.scale, in: {x: c}}\n  b: {use: toy.scale, in: {x: a}}\n  c: {use: toy.scale, in: {x: b}}\n",
            "the stages feed each other in a cycle: ",
        ),
        (
            SOURCE + "  a: {use: toy.scale}\n  b: {use: toy.scale, in: {x: i}}\n"
            "  c: {use: toy.scale, in: {x: i}}\n  t: {use: toy.total}\n",
            "stage 't': port xs: All[Number] could be fed by a, b, c; choose with `in: {xs: …}`",
        ),
    ],
)
def test_mistakes_name_the_stage_and_the_remedy(wired: Wire, stages: str, message: str) -> None:
    with pytest.raises(WorkflowError, match=re.escape(message)) as caught:
        wired(stages)
    assert all(re.match(r".*wf\.yaml:[0-9]+:[0-9]+: ", one) for one in caught.value.problems)


def test_a_mistake_is_reported_where_it_is_in_the_file(wired: Wire) -> None:
    with pytest.raises(WorkflowError) as caught:
        wired(SOURCE + "  s: {use: toy.scale, in: {y: i, x: j}}\n  p: {use: toy.difference, in: {ends: s}}\n")
    places = [re.sub(r".*wf\.yaml:", "", one).split(": ")[0] for one in caught.value.problems]
    assert places == ["5:31", "5:37", "6:12"]


def test_problems_of_wiring_are_those_of_wire(toy: Toy) -> None:
    workflow = toy.session().workflow
    assert wiring_problems(workflow.stages) == []
    assert wire(workflow).order == toy.session().graph.order
    some = {name: entry for name, entry in workflow.stages.items() if name != "images"}
    found = wiring_problems(some)
    assert len(found) == 2
    assert "stage 'scaled' needs x: Each[Number], but no earlier stage produces Number" in found[0]
    assert "port 'names': there is no stage 'images'" in found[1]
