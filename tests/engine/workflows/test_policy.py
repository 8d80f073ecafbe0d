"""What a workflow says of errors and of quality, stage by stage; and the examples of its reference."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.policy import RESERVED_KEYS
from pano_mvs.engine.workflows.wiring import wire
from pano_mvs.engine.workflows.workflow import WorkflowReader
from pano_mvs.session.session import presets_folder
from tests.engine.conftest import Toy, ran

REFERENCE = Path(__file__).parents[3] / "docs" / "workflows.md"


@pytest.mark.parametrize(
    ("gate", "requires"),
    [
        ("{value: 31}", "value is 30, but `gate` requires 31 or more"),
        ("{value: {min: 30.5}}", "value is 30, but `gate` requires 30.5 or more"),
        ("{value: {max: 29}}", "value is 30, but `gate` requires 29 or less"),
        ("{value: {min: 1, max: 29}}", "29 or less"),
        ("{value: 30}", ""),
        ("{value: {min: 30, max: 30}}", ""),
        ("{value: {max: 1e9}}", ""),
        ("{}", ""),
    ],
)
def test_thresholds_have_a_minimum_and_a_maximum(toy: Toy, gate: str, requires: str) -> None:
    result = toy.run(f"scaled.gate={gate}")
    assert result.exit_code == (4 if requires else 0)
    assert requires in result.stopped
    assert ("mean" in ran(result)) != bool(requires), "what reads from the stage waits until it has passed"


def test_a_gate_that_is_changed_computes_nothing_again(finished: Toy) -> None:
    assert ran(finished.run("scaled.gate={value: {max: 99}}", "scaled.retries=2", "scaled.timeout_s=100")) == {}
    assert finished.run("scaled.gate={value: {max: 9}}").exit_code == 4, "a cached stage is held to it too"


@pytest.mark.parametrize(("share", "code"), [(0.8, 3), (0.81, 4)])
def test_the_share_that_must_succeed(toy: Toy, share: float, code: int) -> None:
    toy.number("3.txt", "13")
    result = toy.run(f"scaled.min_success={share}")
    assert result.exit_code == code
    assert ("4 of 5 units succeeded, min_success is 0.81" in result.stopped) == (code == 4)


def test_what_could_not_run_counts_as_not_done(toy: Toy) -> None:
    toy.number("3.txt", "13")
    assert "stage 'mean': 4 of 5 units succeeded" in toy.run("mean.min_success=0.9").stopped


def test_a_source_stops_at_an_image_that_cannot_be_used(toy: Toy) -> None:
    toy.edit(
        "plug.py", lambda text: text.replace('{"text": path})', '{"text": path}, "no good" * (path.name == "3.txt"))')
    )
    assert toy.run().exit_code == 3
    result = toy.run("images.on_error=stop")
    assert result.exit_code == 4
    assert result.stopped == "stage 'images' has on_error: stop, and 3.txt cannot be used: no good"


@pytest.mark.parametrize(("retries", "code"), [(0, 3), (1, 3), (2, 0)])
def test_a_unit_is_tried_again_so_often(toy: Toy, retries: int, code: int) -> None:
    count = toy.folder / "count"
    count.touch()
    failing = f"""
    from pathlib import Path
    count = Path({str(count)!r})
    if x.value == 30:
        count.write_text(count.read_text() + "x")
    if x.value == 30 and len(count.read_text()) < 3:"""
    toy.edit("plug.py", lambda text: text.replace("    if x.value == 13:", failing))
    assert toy.run(f"scaled.retries={retries}").exit_code == code
    assert len(count.read_text()) == retries + 1


EXAMPLES = re.findall(r"```yaml\n(.*?)```", REFERENCE.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("text", EXAMPLES, ids=range(len(EXAMPLES)))
def test_the_examples_of_the_reference_are_sound(text: str) -> None:
    graph = wire(WorkflowReader("t", presets_folder(), Registry.installed(), presets=presets_folder()).read(text))
    order = list(graph.order)
    if "levelled" in order:
        assert order.index("levelled") == order.index("refined") + 1


def test_the_reference_names_every_reserved_key() -> None:
    text = REFERENCE.read_text(encoding="utf-8")
    assert len(EXAMPLES) >= 4
    assert [key for key in RESERVED_KEYS if f"`{key}`" not in text] == []
