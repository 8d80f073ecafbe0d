"""Workflows that mean harm, or are none: refused with the place and the remedy, in time, and nothing is written."""

from __future__ import annotations

import os
import random
import socket
import string
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pano_mvs.core.errors import InputError, UsageError, WorkflowError
from pano_mvs.core.file_names import folder_problem, is_plain_name, item_problem
from pano_mvs.core.yaml_text import MAX_PROBLEMS, parse_yaml
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.wiring import wire
from pano_mvs.engine.workflows.workflow import WorkflowReader, find_workflow, load_workflow
from pano_mvs.engine.workflows.workflow_file import MAX_BYTES, read_text
from pano_mvs.session.session import presets_folder
from tests.engine.conftest import Toy

SHIPPED = [path.read_text(encoding="utf-8") for path in sorted(presets_folder().glob("*.yaml"))]
INSTALLED = Registry.installed()
SLOWEST_S = 30.0
"""Of processor time; what is measured takes about 1 s, also for the largest texts that are read."""


def refusals(text: str) -> list[str]:
    """Return why a text is refused; it must be, and soon."""
    began = time.process_time()
    with pytest.raises(WorkflowError) as caught:
        wire(WorkflowReader("wf.yaml", Path(), INSTALLED).read(text))
    assert time.process_time() - began < SLOWEST_S
    assert len(caught.value.problems) <= MAX_PROBLEMS + 1
    assert max(map(len, caught.value.problems)) < 2000, "a message is not as long as what it refuses"
    return caught.value.problems


def inside(value: str) -> str:
    """Return a workflow with a value in it."""
    return f"pano_mvs: 1\nstages:\n  images: {{use: source.folder, path: {value}}}\n"


PYTHON = "tag:yaml.org,2002:python"
NO = "is not allowed; write a plain value"
BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join(9 * [f'*{old}'])}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (inside("!!python/object/apply:os.system [id]"), f"wf.yaml:3:38: tag '{PYTHON}/object/apply:os.system' {NO}"),
        (inside("!!python/object:os.x {a: 1}"), f"wf.yaml:3:38: tag '{PYTHON}/object:os.x' {NO}"),
        (inside("!include secret"), "wf.yaml:3:38: tag '!include' is not allowed"),
        (inside("!!binary aGVsbG8="), "is not allowed"),
        (inside("!!set {a, b}"), "is not allowed"),
        ("!!python/object:os.x {pano_mvs: 1}", "wf.yaml:1:1: tag"),
        ("pano_mvs: 1\n!!python/name:os.x stages: {}", f"wf.yaml:2:1: tag '{PYTHON}/name:os.x' is not"),
        ("? [a, b]\n: 1", "wf.yaml:1:3: a key must be a plain scalar"),
        (BOMB, "too large; at most 100000 values are allowed"),
        ("a: &a [*a]", "wf.yaml:1:4: too large; at most 40 levels are allowed"),
        ("a: *nothing", "wf.yaml:1:4: found undefined alias"),
        ("pano_mvs: 1\npano_mvs: 1\nstages: {}", "wf.yaml:2:1: key 'pano_mvs' occurs twice"),
        ("pano_mvs: 1\nstagse: {}", "wf.yaml:2:1: unknown key 'stagse'. Did you mean 'stages'?"),
        ("stages: {a: {use: x}}", "wf.yaml:1:1: the key `pano_mvs: 1` is missing"),
        ("pano_mvs: 7\nstages: {a: {use: x}}", "wf.yaml:1:11: workflow format 7"),
        ("pano_mvs: 1\nstages: [a]", "wf.yaml:2:9: `stages:` must be a mapping"),
        ("pano_mvs: 1\nstages: {a: {path: capture}}", "wf.yaml:2:10: stage 'a' needs `use: NAME`"),
        ("pano_mvs: [1", "expected"),
        ("", "wf.yaml:1:1: the file is empty"),
        ("pano_mvs: 1\nplugins: plug.py\nstages: {a: {use: x}}", "wf.yaml:2:10: plugins must be a list"),
        ("pano_mvs: 1\nplugins: [gone.py]\nstages: {a: {use: x}}", "gone.py does not exist"),
        ("[" * 2_000, "wf.yaml:1:42: nested too deeply; at most 40 levels are allowed"),
        ("{a: " * 2_000, "wf.yaml:1:162: nested too deeply"),
        ("- " * 2_000, "nested too deeply"),
        ("".join(" " * level + "a:\n" for level in range(500)), "wf.yaml:41:41: nested too deeply"),
        (inside("1e400"), "wf.yaml:3:38: '1e400' is not a finite number"),
        (inside("-.inf"), "'-.inf' is not a finite number"),
        (inside(".NaN"), "wf.yaml:3:38: '.NaN' is not a"),
        (inside("9" * 5000), "is not a usable number"),
        (inside("0x" + "f" * 5000), "is not a usable number"),
        (inside("1" + "_1" * 5000), "is not a usable number"),
        (inside("a, path: b"), "wf.yaml:3:41: key 'path' occurs twice (first in line 3)"),
        (inside('"a\\0b"'), "contains control characters; remove them"),
        (inside('"\\e[2J"'), "contains control characters"),
        (inside('"\\ud800"'), ""),
        ("pano_mvs: 1\0", "wf.yaml: line 1, column 12: the control character '\\x00' is not allowed; remove it"),
        ("pano_mvs: 1\n\x1b[2Jstages: {}", "line 2, column 1: the control character '\\x1b'"),
        ('"pa\\0no": 1', "wf.yaml:1:1: key 'pa\\x00no' contains control characters"),
        ("%YAML 1.1\n---\npano_mvs: yes", "write a plain value"),
        ("%YAML 9.9\n---\na: 1", "wf.yaml:"),
        ("a: 1\n---\nb: 2", "wf.yaml:2:1: but found another document"),
        (inside("x, to: ../up"), "wf.yaml:3:45: stage 'images': to: must be a folder inside the output folder"),
        ("pano_mvs: 1\nname: CON\nstages: {a: {use: pairs.exhaustive}}", "wf.yaml:2:7: name must consist"),
        ("pano_mvs: 1\ndescription: [x]\nstages: {a: {use: pairs.exhaustive}}", "wf.yaml:2:14: description must be"),
        ("pano_mvs: 1\nstages: {aux.x: {use: pairs.exhaustive}}", "stage name 'aux.x' must consist"),
        ("pano_mvs: 1\nstages: {a/../b: {use: pairs.exhaustive}}", "stage name 'a/../b' must consist"),
        ("pano_mvs: 1\nstages: {" + "a" * 500 + ": {use: pairs.exhaustive}}", "must consist"),
        ("pano_mvs: true\nstages: {a: {use: pairs.exhaustive}}", "wf.yaml:1:11: workflow format True is not supported"),
        ("pano_mvs: 1\nplugins: ['']\nstages: {a: {use: pairs.exhaustive}}", "plugin file"),
        ("pano_mvs: 1\nplugins: [/dev/zero]\nstages: {a: {use: pairs.exhaustive}}", "wf.yaml:2:11: plugin file"),
        ("pano_mvs: 1\nextends: /dev/zero\nstages: {a: {use: pairs.exhaustive}}", "is not a regular file"),
        ("pano_mvs: 1\nextends: " + "a" * 5000, "extends: there is no file"),
    ],
)
def test_hostile_texts(text: str, what: str) -> None:
    found = refusals(text)
    assert any(what in line for line in found), found
    assert all(line.startswith(("wf.yaml:", "these are")) for line in found), found


@pytest.mark.parametrize(
    "text",
    [
        "pano_mvs: 1\nstages:\n" + "".join(f"  a{number}: {{use: nothing}}\n" for number in range(3500)),
        pytest.param(
            "pano_mvs: 1\nstages:\n" + "".join(f"  a{number}: {{use: pairs.exhaustive}}\n" for number in range(2400)),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "pano_mvs: 1\nstages:\n  a:\n    use: depth.sweep\n" + "".join(f"    planse{n}: 1\n" for n in range(5_000)),
            marks=pytest.mark.slow,
        ),
        "".join(f"key{number}: 1\n" for number in range(4_000)),
        pytest.param("a: 1\n" * 8_000, marks=pytest.mark.slow),
        "pano_mvs: 1\nstages: {a: {use: " + "d" * 80_000 + "}}",
        "pano_mvs: 1\nstages: {" + "d" * 80_000 + ": {use: x}}",
        "x" * 90_000 + ": 1",
        "a: !!" + "x" * 80_000 + " 1",
        "a: " + "9" * 80_000,
        "&a " * 10_000,
        pytest.param("[" + "&a x, " * 8_000, marks=pytest.mark.slow),
        "? " * 20_000,
        "'" * 80_000,
        "# " * 40_000,
        "a: |\n" + " x\n" * 25_000,
    ],
    ids=range(16),
)
def test_large_texts_are_refused_in_time(text: str) -> None:
    assert len(text) <= MAX_BYTES
    assert refusals(text)


@pytest.mark.parametrize(
    "to",
    [
        "..",
        "../up",
        "a/../../b",
        "/abs",
        "\\\\host\\share",
        "a\\..\\b",
        "C:/x",
        "c:x",
        "nul",
        "a/CON.txt",
        "a/lpt1",
        "a\0b",
        "a\nb",
        "what?",
        "a|b",
        "a.",
        "a /b",
        "x" * 300,
        "logs",
        "LOGS/x",
        "run.json",
        "./report.html",
    ],
)
def test_folders_that_lead_outside_or_do_not_exist_everywhere(to: str) -> None:
    assert folder_problem(to)


@pytest.mark.parametrize("to", ["", ".", "a", "./a", "a/b.c", "größe", "a b", "logsx", "console", "a:b"[:1]])
def test_folders_that_are_fine(to: str) -> None:
    assert folder_problem(to) == ""


@pytest.mark.slow
@given(st.text(max_size=30))
def test_what_passes_as_a_name_stays_inside(text: str) -> None:
    """Joined to a folder, names of stages, items and folders stay below it."""
    root = Path("/root/of/all")
    if is_plain_name(text) or not item_problem(text) or (text and not folder_problem(text)):
        joined = Path(os.path.normpath(root / text))
        assert joined == root or root in joined.parents


@pytest.mark.parametrize("name", ["", "../a.jpg", "a/../../b", "/etc/passwd", "a\\..\\b", "C:a", "a\0b", "a\x1b[2J"])
def test_items_of_such_names_are_left_out(name: str) -> None:
    assert "rename it" in item_problem(name)


def test_files_that_are_no_workflows(tmp_path: Path) -> None:
    (tmp_path / "folder.yaml").mkdir()
    (tmp_path / "large.yaml").write_bytes(b"#" * (MAX_BYTES + 1))
    (tmp_path / "picture.yaml").write_bytes(bytes(range(256)))
    (tmp_path / "link.yaml").symlink_to("link.yaml")
    for name, what in {
        "folder.yaml": "is a folder: give the path of a YAML file",
        "large.yaml": "bytes, but at most 100000 are allowed: is it a workflow?",
        "picture.yaml": "byte 128 is not UTF-8. Save it as UTF-8 text",
        "link.yaml": "cannot be read: ",
        "gone.yaml": "cannot be read: ",
    }.items():
        with pytest.raises(InputError, match=r"workflow .*" + name) as caught:
            load_workflow(tmp_path / name, INSTALLED)
        assert what in str(caught.value)
    assert find_workflow(str(tmp_path / "folder.yaml"), presets_folder())[0] == tmp_path / "folder.yaml"
    with pytest.raises(UsageError, match="there is no workflow file"):
        find_workflow("x" * 5000, presets_folder())


@pytest.mark.skipif(os.name != "posix", reason="pipes and sockets have names on POSIX systems only")
def test_pipes_sockets_and_devices_are_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    monkeypatch.chdir(tmp_path)
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind("socket.yaml")
        for path in (tmp_path / "pipe.yaml", tmp_path / "socket.yaml", Path("/dev/zero")):
            with pytest.raises(InputError, match="is not a regular file"):
                read_text(path)
            reader = WorkflowReader("t", tmp_path, INSTALLED)
            with pytest.raises(WorkflowError, match="is not a regular file"):
                reader.read(f"pano_mvs: 1\nextends: {path}\n")
            with pytest.raises(WorkflowError, match="plugin file"):
                WorkflowReader("t", tmp_path, Registry()).read(
                    f"pano_mvs: 1\nplugins: [{path}]\nstages: {{a: {{use: b}}}}"
                )


def mutated(text: str, seed: int) -> str:
    """Return a workflow with a few characters, words or lines changed, lost, doubled or moved."""
    draw = random.Random(seed)
    signs = string.printable + "äß\0\x85\u2028\ufeff\ud800🙂" + "[]{}:,-&*!|>'\"%@`#?\n\t " * 3
    for _ in range(draw.randint(1, 6)):
        a, b = sorted(draw.choices(range(len(text) + 1), k=2))
        b = min(b, a + draw.choice([0, 1, 3, 40]))
        words = ["null", "1e999", "{}", "[]", "true", "-1", "&a", "*a", "<<: ", "!!x ", "---\n"]
        new = draw.choice(
            ["", text[a:b] * 2, draw.choice(signs), "".join(draw.choices(signs, k=5)), draw.choice(words)]
        )
        text = text[:a] + new + text[b:]
    return text


def refusal_of(read: Callable[[], object]) -> list[str]:
    """Return why something cannot be read, nothing if it can; any other error is a bug."""
    try:
        read()
    except WorkflowError as error:
        return error.problems
    return []


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 2**32), st.sampled_from(SHIPPED))
def test_mutated_workflows_are_read_or_refused(seed: int, text: str) -> None:
    reader = WorkflowReader("t", presets_folder(), INSTALLED, presets=presets_folder())
    assert all(refusal_of(lambda: wire(reader.read(mutated(text, seed)))) or ["fine"])


@settings(max_examples=150, deadline=None)
@given(st.one_of(st.text(max_size=300), st.text(alphabet="[]{}:,-&*!|>'\"%@#?\n\t ab1.~", max_size=120)))
def test_any_text_is_a_value_or_a_list_of_problems(text: str) -> None:
    assert all(line.startswith("t:") for line in refusal_of(lambda: parse_yaml(text, "t").plain()))


@settings(max_examples=60, deadline=None)
@given(st.text(max_size=60), st.sampled_from(["depth", "images", "views.sources", "plugins", ""]))
def test_any_override_is_applied_or_refused(text: str, target: str) -> None:
    reader = WorkflowReader("t", presets_folder(), INSTALLED, presets=presets_folder())
    overrides = [f"{target}{text}", f"{target}={text}"]
    found = refusal_of(lambda: reader.read("pano_mvs: 1\nextends: quickstart\n", overrides=overrides))
    assert all(line.startswith("--set") for line in found)


def test_items_and_links_do_not_lead_a_run_outside(toy: Toy, tmp_path: Path) -> None:
    """A plugin lists an item with a name that climbs; the output folder holds links that lead elsewhere."""
    outside = tmp_path / "outside"
    outside.mkdir()
    out = toy.folder / "out"
    out.mkdir()
    for name in ("logs", "mean"):
        (out / name).symlink_to(outside, target_is_directory=True)
    for name in ("all.txt", ".pano-mvs-output", "run.json"):
        (out / name).symlink_to(outside / name)
    climbing = 'yield SourceItem("../" * (path.name == "3.txt") + path.name,'
    toy.edit("plug.py", lambda text: text.replace("yield SourceItem(path.name,", climbing))
    toy.edit("plug.py", lambda text: text.replace("ctx.metric(", "print(x); ctx.metric("))
    with pytest.raises(Exception, match="it would leave the output folder"):
        toy.run()
    (out / "mean").unlink()
    result = toy.run()
    assert [failure.cause for failure in result.failures] == [
        "its name '../3.txt' would lead outside the output folder; rename it"
    ]
    assert list(outside.iterdir()) == []
    assert (out / "all.txt").is_file()
    assert not (out / "all.txt").is_symlink()
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != "__pycache__") == [
        "cache",
        "capture",
        "helper.py",
        "out",
        "outside",
        "plug.py",
        "wf.yaml",
    ]
