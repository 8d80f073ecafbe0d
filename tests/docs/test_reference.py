"""The pages that are made from the code leave nothing out; the site itself is built by CI, `mkdocs build --strict`."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from ruamel.yaml import YAML

from pano_mvs import api
from pano_mvs.cli.plugins.new import rendered
from pano_mvs.engine.workflows.policy import RESERVED_KEYS

ROOT = Path(__file__).parents[2]
HOOKS = ROOT / "docs" / "_hooks"


@pytest.fixture(scope="module", autouse=True)
def hooks_on_path() -> Iterator[None]:
    """Import the hooks as mkdocs does, from their folder, and forget them afterwards."""
    sys.path.insert(0, str(HOOKS))
    yield
    sys.path.remove(str(HOOKS))
    for path in HOOKS.glob("*.py"):
        sys.modules.pop(path.stem, None)


def hook(name: str) -> ModuleType:
    return importlib.import_module(name)


@pytest.fixture(scope="module")
def stages() -> str:
    return str(hook("stage_page").stage_page())


def section(page: str, title: str) -> str:
    """Return a page from a heading to the next of its level or above."""
    found = re.search(rf"^(#+) {re.escape(title)}( \{{[^\n]*)?\n(.*?)(?=^#{{1,3}} |\Z)", page, re.DOTALL | re.MULTILINE)
    assert found, title
    return found[3]


def test_every_stage_is_described_with_all_its_settings_and_ports(stages: str) -> None:
    for name, spec in hook("stage_page").shipped().stages.items():
        told = section(stages, name)
        assert spec.doc.split()[0] in told
        for setting, info in spec.params_type.model_fields.items():
            assert f"| `{info.alias or setting}` |" in told, (name, setting)
        for port in spec.all_ports:
            assert re.search(rf"`{port.name}` `{port.cardinality}` .{port.kind.kind_name()}", told)


def test_every_kind_of_stage_is_introduced() -> None:
    known = hook("stage_page").KINDS
    assert {name.partition(".")[0] for name in hook("stage_page").shipped().stages} <= known.keys()


def test_a_stage_names_the_pages_that_tell_of_it(stages: str) -> None:
    assert "[Frames and scale](../frames_and_scale.md)" in section(stages, "poses.level")
    assert "[quality](presets.md#quality)" in section(stages, "depth.patchmatch")


def test_what_every_stage_takes_is_listed(stages: str) -> None:
    told = section(stages, "What every stage takes")
    assert set(RESERVED_KEYS) == set(re.findall(r"^\| `(\w+)` \|", told, re.MULTILINE))


@pytest.mark.slow
def test_everything_in_the_api_is_described_once() -> None:
    page = hook("api_page").api_page()
    headings = re.findall(r"^### (\w+) \{ #(\w+) \}\n\n(.*)", page, re.MULTILINE)
    assert sorted(name for name, *_ in headings) == sorted(api.__all__)
    assert all(anchor == name.lower() and text for name, anchor, text in headings)


def test_kinds_that_stages_refer_to_are_in_the_api(stages: str) -> None:
    referred = set(re.findall(r"\(api\.md#(\w+)\)", stages))
    assert "rangemap" in referred
    assert referred <= set(re.findall(r"\{ #(\w+) \}", hook("api_page").api_page()))


def test_every_command_is_listed_with_its_options() -> None:
    page = hook("command_page").command_page()
    assert {"pano-mvs run", "pano-mvs cache gc", "pano-mvs stage show"} <= set(re.findall(r"^## (.*?) \{", page, re.M))
    assert "`--images" in section(page, "pano-mvs run")


def test_every_preset_is_shown_as_it_is() -> None:
    page = hook("preset_page").preset_page()
    for path in [*(ROOT / "workflows").glob("*.yaml"), *(ROOT / "workflows" / "groups").glob("*.yaml")]:
        assert path.read_text(encoding="utf-8").rstrip() in page


def test_the_conventions_are_those_of_the_code() -> None:
    from pano_mvs import geometry

    page = hook("conventions_page").conventions_page()
    words = re.findall(r"[\w°φθπ½]+", geometry.__doc__ or "")
    assert set(words) <= set(re.findall(r"[\w°φθπ½]+", page.replace("\\_", "_")))


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a | b", "a \\| b"),
        ("sizes_rad of [H, W]", "sizes\\_rad of \\[H, W\\]"),
        ("`a_b` and <image>", "`a_b` and &lt;image&gt;"),
        ("two\n    lines", "two lines"),
    ],
)
def test_text_of_the_code_is_shown_as_it_is(text: str, shown: str) -> None:
    assert hook("markdown_text").cell(text) == shown


def test_columns_that_say_nothing_are_left_out() -> None:
    table = hook("markdown_text").table(("a", "b"), [("1", ""), ("2", "")])
    assert table == "| a |\n| --- |\n| 1 |\n| 2 |"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("[guide](docs/plugins.md#masks)", "[guide](plugins.md#masks)"),
        ("[example](plugins/pano_mvs_example/README.md)", "[example](example_plugin.md)"),
        ("[`plugins/`](plugins/README.md)", "[`plugins/`](installable_plugins.md)"),
        ("[a licence](LICENSE)", "a licence (`LICENSE`)"),
        ("| `a \\| b` | c |", "| `a | b` | c |"),
        ("[site](https://example.org)", "[site](https://example.org)"),
        ("```\n[x](y.md)\n```", "```\n[x](y.md)\n```"),
    ],
)
def test_links_lead_to_where_files_are_in_the_site(text: str, shown: str) -> None:
    assert hook("repository_pages").with_site_links(text, "contributing.md", "CONTRIBUTING.md") == shown


def test_every_page_is_in_the_navigation() -> None:
    settings = YAML(typ="safe").load(ROOT / "mkdocs.yml")
    entries = re.findall(r"[\w/]+\.md", str(settings["nav"]))
    assert len(entries) == len(listed := set(entries)), "a page is there twice"
    written = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").glob("**/*.md")}
    assert written <= listed
    made = {f"reference/{name}.md" for name in ("stages", "presets", "commands", "api", "conventions")}
    assert listed - written == made | hook("repository_pages").PAGES.keys()


def test_the_site_shows_the_plugins_that_are_written() -> None:
    name = "plugins/examples/vests.py"
    page = hook("markdown_text").with_plugins(f"Text:\n\n<!-- plugin: filter cut -->\n<!-- file: {name} -->\nMore.\n")
    written, kept = rendered("filter", "cut")[0], (ROOT / name).read_text(encoding="utf-8")
    assert page == f"Text:\n\n```python\n{written}```\n```python\n{kept}```\nMore.\n"
