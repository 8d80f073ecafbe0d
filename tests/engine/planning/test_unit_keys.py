"""Units of a stage from what its producers made: which run, wait, or cannot, and what their keys are made of."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from types import ModuleType

import pytest

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.engine.cache.store import ItemRef, Store
from pano_mvs.engine.planning.unit_keys import KEY_SCHEMA, resolve, resolve_source
from pano_mvs.engine.planning.units import PENDING, WHOLE, StageState, Unit
from pano_mvs.engine.stages.stage import SourceItem
from pano_mvs.engine.stages.stage_code import stage_code
from pano_mvs.scene import Axis, Pairs, Record, Views
from tests.engine.conftest import Toy
from tests.engine.workflows.test_wiring import MORE

DIGEST = {name: digest_from_value(name) for name in ("a", "b", "c", "s", "ab")}


def ref(name: str) -> ItemRef:
    return ItemRef("Number", digest_from_value(name), {})


def images(*names: str, pending: str = "", failed: str = "") -> StageState:
    """Return the state of a stage of images; those that are pending or failed have no value."""
    there = {name: ref(name) for name in names if name not in pending and name not in failed}
    members: dict[str, tuple[str, ...]] = {name: (name,) for name in names}
    return StageState(Axis.IMAGE, there, {}, members, dict.fromkeys(failed, "dark"), set(pending))


OPEN = StageState(Axis.IMAGE, open=True)


class Rest:
    """The units that do not run."""

    def __init__(self, state: StageState) -> None:
        self.members, self.blocked, self.open = state.members, state.failed, state.open
        self.waiting = [name for name in state.members if name in state.pending]


class Resolved:
    """A toy workflow with another stage at its end, of which states are put in by hand."""

    def __init__(self, toy: Toy) -> None:
        toy.edit("plug.py", lambda text: text + MORE)
        more = (
            "plus: {use: toy.plus, in: {x: scaled}}",
            "any: {use: toy.total_of_any, in: {xs: scaled}}",
            "again: {use: toy.scale, in: {x: shifted}}",
            "seen: {use: toy.view, in: {mean: mean, x: shifted}}",
            "around: {use: toy.around, in: {x: images, near: scaled}}",
        )
        toy.edit("wf.yaml", lambda text: text + "".join(f"  {line}\n" for line in more))
        self.toy = toy
        self.session = toy.session()
        self.store = Store(toy.folder / "cache")

    def __call__(
        self, stage: str, only: Mapping[str, frozenset[str]] | None = None, **states: StageState
    ) -> tuple[dict[str, Unit], Rest]:
        graph, own = replace(self.session.graph, only=only or {}), StageState(Axis.ONE)
        known = states | {stage: own}
        found = resolve(self.session.workflow.stages[stage], graph, states=known, store=self.store)
        return {unit.item: unit for unit in found}, Rest(own)


@pytest.fixture
def resolved(toy: Toy) -> Resolved:
    return Resolved(toy)


def test_a_unit_reads_its_own_item_or_waits_or_says_what_it_lacks(resolved: Resolved) -> None:
    units, rest = resolved("scaled", images=images("a", "b", "c", "d", pending="b", failed="c"))
    assert list(units) == ["a", "d"]
    assert (units["a"].inputs, units["a"].members, units["a"].label) == ({"x": ref("a")}, ("a",), "scaled:a")
    assert (rest.waiting, rest.blocked, rest.open) == (["b"], {"c": "needs images:c, which failed"}, False)
    assert rest.members == {name: (name,) for name in "abcd"}
    state = images("a", "b")
    del state.items["b"]
    assert resolved("scaled", images=state)[1].blocked == {"b": "needs images:b, which has no result"}
    units, rest = resolved("scaled", images=OPEN)
    assert (units, rest.open, rest.blocked) == ({}, True, {})


def test_a_stage_that_is_confined_has_the_units_that_are_asked_for(resolved: Resolved) -> None:
    units, rest = resolved("scaled", {"scaled": frozenset({"c", "a"})}, images=images("a", "b", "c"))
    assert list(units) == list(rest.members) == ["a", "c"]
    with pytest.raises(UsageError, match=r"^scaled has no unit 'x'; it has: a, b$"):
        resolved("scaled", {"scaled": frozenset({"x", "z"})}, images=images("a", "b"))
    many = images(*(f"{number:02d}" for number in range(21)))
    with pytest.raises(UsageError, match=r"18, 19 …$"):
        resolved("scaled", {"scaled": frozenset({"x"})}, images=many)


def test_names_of_what_will_come_count_and_of_what_failed_do_not(resolved: Resolved) -> None:
    units, rest = resolved("pairs", scaled=images("a", "b", "c", pending="b", failed="c"))
    assert units[WHOLE].inputs == {"names": {"a": ref("a"), "b": PENDING}}
    assert units[WHOLE].identity["inputs"] == {"names": ["a", "b"]}
    assert (units[WHOLE].label, rest.waiting) == ("pairs", [])
    assert resolved("pairs", scaled=images("a", failed="a"))[1].blocked == {WHOLE: "needs scaled, which failed"}
    assert resolved("pairs", scaled=images())[1].blocked == {WHOLE: "needs scaled, which has no result"}
    assert resolved("pairs", scaled=OPEN)[1].waiting == [WHOLE]


def test_a_gather_waits_for_all_and_does_without_what_failed(resolved: Resolved) -> None:
    units, _ = resolved("shifted", scaled=images("a", "b", "c", failed="b"))
    assert units[WHOLE].inputs == {"xs": {"a": ref("a"), "c": ref("c")}}
    assert units[WHOLE].identity["inputs"] == {"xs": [["a", DIGEST["a"]], ["c", DIGEST["c"]]]}
    assert resolved("shifted", scaled=images("a", "b", pending="b"))[1].waiting == [WHOLE]
    assert resolved("shifted", scaled=OPEN)[1].waiting == [WHOLE]
    assert resolved("shifted", scaled=images("a", failed="a"))[1].blocked == {WHOLE: "needs scaled, which failed"}


def test_an_optional_gather_is_given_nothing_if_the_other_stage_had_nothing_to_do(resolved: Resolved) -> None:
    units, _ = resolved("any", scaled=images())
    assert units[WHOLE].inputs == {"xs": None}
    assert resolved("any", scaled=images("a", failed="a"))[1].blocked == {WHOLE: "needs scaled, which failed"}
    assert resolved("any", scaled=images("a", pending="a"))[1].waiting == [WHOLE]


def whole(reference: ItemRef | None, *, pending: bool = False, failed: bool = False) -> StageState:
    items = {} if reference is None else {WHOLE: reference}
    return StageState(Axis.ONE, items, {}, {WHOLE: ()}, {WHOLE: "x"} if failed else {}, {WHOLE} if pending else set())


def test_a_pair_needs_both_ends(resolved: Resolved) -> None:
    index = whole(resolved.store.put_value(Pairs((("b", "a"), ("b", "c"), ("a", "d")))))
    units, rest = resolved("difference", pairs=index, scaled=images("a", "b", "c", "d", pending="c", failed="d"))
    assert list(units) == ["b | a"]
    unit = units["b | a"]
    assert unit.members == ("b", "a")
    ends = unit.inputs["ends"]
    assert isinstance(ends, dict)
    assert list(ends) == ["b", "a"]
    assert unit.identity["inputs"] == {"ends": [DIGEST["b"], DIGEST["a"]]}
    assert rest.waiting == ["b | c"]
    assert rest.blocked == {"a | d": "needs scaled:d, which failed"}
    assert list(rest.members) == ["b | a", "b | c", "a | d"]


def test_a_view_does_with_the_neighbours_that_there_are(resolved: Resolved) -> None:
    index = whole(resolved.store.put_value(Views({"a": ("b", "c"), "b": ("c",), "d": ("a", "e"), "c": ()})))
    units, rest = resolved("mean", views=index, scaled=images("a", "b", "c", "d", "e", failed="c", pending="e"))
    assert list(units) == ["a"]
    assert units["a"].inputs == {"own": ref("a"), "around": {"b": ref("b")}}
    assert units["a"].members == ("a",)
    assert units["a"].identity["inputs"] == {"own": DIGEST["a"], "around": [DIGEST["b"]]}
    assert rest.waiting == ["d"]
    assert rest.blocked == {
        "b": "needs scaled:c, which failed",
        "c": "needs scaled:c, which failed",
    }
    lonely, rest = resolved("mean", views=index, scaled=images("a", "b", "c", "d", "e"))
    assert list(lonely) == ["a", "b", "d"]
    assert rest.blocked == {"c": "needs scaled, which has no result"}


def test_a_stage_for_every_image_does_without_neighbours(resolved: Resolved) -> None:
    index = whole(resolved.store.put_value(Views({"a": ("b", "c"), "c": ("a", "b")})))
    states = {"images": images("a", "b", "c", "d"), "views": index}
    units, rest = resolved("around", None, **states, scaled=images("a", "b", "c", "d", failed="c"))
    assert rest.blocked == {}
    assert units["a"].inputs == {"x": ref("a"), "near": {"a": ref("a"), "b": ref("b")}}
    assert units["b"].inputs == {"x": ref("b"), "near": {}}, "it is not in the index"
    assert units["c"].inputs == {"x": ref("c"), "near": {"a": ref("a"), "b": ref("b")}}, "its own has failed"
    assert units["d"].inputs == {"x": ref("d"), "near": {}}
    assert units["a"].members == ("a",)
    assert resolved.session.graph.axes["around"] is Axis.IMAGE
    assert resolved("around", None, **states, scaled=images("a", "b", "c", "d", pending="c"))[1].waiting == ["a", "c"]
    assert resolved("around", None, **{**states, "views": OPEN}, scaled=images("a"))[1].open
    failed = {**states, "views": whole(None, failed=True)}
    assert resolved("around", None, **failed, scaled=images("a"))[1].blocked == {WHOLE: "needs views, which failed"}


@pytest.mark.parametrize("stage", ["difference", "mean"])
def test_without_an_index_no_unit_is_known(resolved: Resolved, stage: str) -> None:
    producer = {"difference": "pairs", "mean": "views"}[stage]
    some = images("a", "b")
    for state in (whole(None, pending=True), OPEN):
        units, rest = resolved(stage, None, scaled=some, **{producer: state})
        assert (units, rest.open, rest.blocked) == ({}, True, {})
    units, rest = resolved(stage, None, scaled=some, **{producer: whole(None, failed=True)})
    assert (units, rest.open) == ({}, False)
    assert rest.blocked == {WHOLE: f"needs {producer}, which failed"}


def test_a_port_that_is_not_connected_is_given_nothing(resolved: Resolved) -> None:
    units, _ = resolved("plus", scaled=images("a"))
    assert units["a"].inputs == {"x": ref("a"), "total": None}
    assert units["a"].identity["inputs"] == {"x": DIGEST["a"], "total": None}


def test_items_of_a_collection_are_known_once_it_is_there(resolved: Resolved) -> None:
    collection = whole(ref("all"))
    collection.exploded = {"a": ref("a"), "b": ref("b")}
    units, _ = resolved("again", shifted=collection)
    assert {name: unit.inputs["x"] for name, unit in units.items()} == {"a": ref("a"), "b": ref("b")}
    assert units["a"].members == ("a",)
    assert resolved("again", shifted=OPEN)[1].open


def test_units_that_read_an_item_of_a_collection_wait_for_it(resolved: Resolved) -> None:
    collection = whole(ref("all"))
    collection.exploded = {"a": ref("a in all")}
    mean = images("a", "b")
    mean.axis = Axis.VIEW
    units, rest = resolved("seen", mean=mean, shifted=collection)
    assert units["a"].inputs == {"mean": ref("a"), "x": ref("a in all")}
    assert rest.blocked == {"b": "needs shifted:b, which has no result"}
    for state in (whole(None, pending=True), OPEN):
        mean.open = state.open
        units, rest = resolved("seen", mean=mean, shifted=state)
        if state.open:
            assert rest.open
            continue
        assert (units, rest.blocked, rest.waiting) == ({}, {}, ["a", "b"])


def test_a_stage_reads_several_producers(resolved: Resolved) -> None:
    pairs = StageState(Axis.PAIR, {"a | b": ref("ab")}, {}, {"a | b": ("a", "b")})
    units, _ = resolved("all", difference=pairs, shifted=whole(ref("s")))
    assert units[WHOLE].identity["inputs"] == {
        "differences": [["a | b", DIGEST["ab"]]],
        "shifted": DIGEST["s"],
    }
    for state, blocked, waiting in (
        (whole(None, failed=True), {WHOLE: "needs shifted, which failed"}, []),
        (whole(None, pending=True), {}, [WHOLE]),
    ):
        units, rest = resolved("all", difference=pairs, shifted=state)
        assert (units, rest.blocked, rest.waiting) == ({}, blocked, waiting)


def test_a_key_is_made_of_the_identity_and_nothing_else(resolved: Resolved) -> None:
    units, _ = resolved("scaled", images=images("a", "b"))
    for unit in units.values():
        static = {name: part for name, part in unit.identity.items() if name != "inputs"}
        assert unit.key == digest_from_value([digest_from_value(static), unit.identity["inputs"]])
    entry = resolved.session.workflow.stages["scaled"]
    code = stage_code(entry.spec, entry.params)
    assert units["a"].identity == {
        "schema": KEY_SCHEMA,
        "stage": "toy.scale",
        "version": 1,
        "code": code.digest,
        "libraries": dict(code.libraries),
        "params": {"by": 3.0},
        "kinds": {"Number": 1},
        "inputs": {"x": DIGEST["a"]},
    }
    same = images("c", "a")
    same.items["c"] = ref("a")
    again, _ = resolved("scaled", images=same)
    assert again["c"].key == again["a"].key == units["a"].key != units["b"].key


def sources(toy: Toy, *items: SourceItem, only: frozenset[str] | None = None) -> tuple[dict[str, Unit], dict[str, str]]:
    """Return the units of a source, and why its other items cannot be used."""
    entry = toy.session().workflow.stages["images"]
    spec = replace(entry.spec, list_items=lambda _: items)
    found = resolve_source(replace(entry, spec=spec), Store(toy.folder / "cache"), only=only)
    assert list(found) == [item.name for item in items if only is None or item.name in only]
    units = {name: unit for name, unit in found.items() if isinstance(unit, Unit)}
    return units, {name: why for name, why in found.items() if isinstance(why, str)}


def test_a_source_s_units_are_known_by_name_and_content(toy: Toy) -> None:
    paths = [toy.folder / "capture" / f"{number}.txt" for number in (1, 2)]
    first, second = (SourceItem(name, {"text": path}) for name, path in zip("ab", paths, strict=True))
    units, _ = sources(toy, first, second)
    digests = {name: unit.identity["inputs"]["files"]["text"] for name, unit in units.items()}
    assert units["a"].identity["inputs"] == {"files": {"text": digests["a"]}, "name": "a"}
    assert digests["a"] != digests["b"]
    assert units["a"].source == replace(first, digests={"text": digests["a"]})
    assert (units["a"].inputs, units["a"].members) == ({}, ("a",))
    renamed, _ = sources(toy, replace(first, name="c"))
    assert renamed["c"].key != units["a"].key
    only, _ = sources(toy, first, second, only=frozenset({"b"}))
    assert list(only) == ["b"]
    assert only["b"].key == units["b"].key


def test_items_of_a_source_that_cannot_be_used_are_blocked(toy: Toy) -> None:
    path = toy.folder / "capture" / "1.txt"
    units, blocked = sources(
        toy,
        SourceItem("a", {"text": path}, problem="too dark"),
        SourceItem("b", {"text": path.with_name("gone")}),
        SourceItem("c", {"text": path}),
        SourceItem("d | e", {"text": path}),
    )
    assert list(units) == ["c"]
    assert blocked.keys() == {"a", "b", "d | e"}
    assert blocked["a"] == "too dark"
    assert "gone: cannot be read" in blocked["b"]
    assert "contains ' | ', which separates the names of a pair" in blocked["d | e"]
    with pytest.raises(InputError, match="images: the item 'a' is listed twice"):
        sources(toy, *[SourceItem("a", {"text": path})] * 2)


def test_a_stage_of_a_module_without_source_counts_by_its_version(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = toy.session().workflow.stages["scaled"]
    monkeypatch.setitem(sys.modules, "compiled_stages", ModuleType("compiled_stages"))

    def function() -> Record:
        raise NotImplementedError

    function.__module__ = "compiled_stages"
    function.__qualname__ = "function"
    code = stage_code(replace(entry.spec, function=function, code_digest=""), entry.params)
    assert (code.digest, code.libraries) == ("", {"compiled_stages": "not installed"})


def test_a_plugin_that_is_a_package_uses_no_library_of_its_own_name(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    texts = {
        "__init__": "from mine.inner import f\nlimit = 1\n",
        "inner": "import numpy\nfrom mine import limit\ndef f(): return numpy.pi * limit\n",
    }
    for name, text in texts.items():
        path = toy.folder / "mine" / f"{name}.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    module = ModuleType("mine")
    module.__file__ = str(toy.folder / "mine" / "__init__.py")
    monkeypatch.setitem(sys.modules, "mine", module)

    def function() -> Record:
        raise NotImplementedError

    function.__module__ = "mine"
    entry = toy.session().workflow.stages["scaled"]
    spec = replace(entry.spec, function=function, code_digest="one")
    code = stage_code(spec, entry.params)
    assert code.libraries.keys() == {"numpy"}
    assert stage_code(spec.with_code("other"), entry.params).digest != code.digest
