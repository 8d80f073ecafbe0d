"""docs/architecture.md agrees with the code: layers, packages, what they import, stages, and every path on the page."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import grimp
import pytest

from pano_mvs import stages
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.session.session import open_session

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
PATHS = sorted(set(re.findall(r"`((?:pano_mvs|workflows|plugins|tests)(?:/[\w./]*)?)`", PAGE)))


def rows(mark: str) -> list[list[str]]:
    """Return the cells of the table that follows a mark, without its head."""
    found = re.search(rf"<!-- {mark} -->\n\|.*\n\|[-|]+\n((?:\|.*\n)+)", PAGE)
    assert found, mark
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in found[1].splitlines()]


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    return grimp.build_graph("pano_mvs", cache_dir=None)


@pytest.mark.parametrize(
    ("mark", "name"),
    [("layers", "Imports go downwards only"), ("engine layers", "The engine's packages import downwards only")],
)
def test_layers_are_those_of_the_import_contract(mark: str, name: str) -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (contract,) = [one for one in settings["tool"]["importlinter"]["contracts"] if one["name"] == name]
    shown = re.search(rf"<!-- {mark} -->\n```text\n(.*?)```", PAGE, re.DOTALL)
    assert shown
    assert shown[1].splitlines() == [layer.replace("pano_mvs.", "") for layer in contract["layers"]]


def test_packages_and_their_imports_are_those_of_the_import_graph(graph: grimp.ImportGraph) -> None:
    packages = graph.find_children("pano_mvs") - {"pano_mvs.__main__"}
    imported = {
        package: {
            other
            for other in packages - {package}
            if graph.direct_import_exists(importer=package, imported=other, as_packages=True)
        }
        for package in packages
    }
    shown = {
        place.strip("`").removesuffix(".py").replace("/", "."): {f"pano_mvs.{x}" for x in re.findall(r"`(\w+)`", names)}
        for place, _, names in rows("packages")
    }
    assert shown == imported


@pytest.mark.parametrize("path", PATHS)
def test_every_path_exists(path: str) -> None:
    assert (ROOT / path).exists()


def test_the_page_names_enough_paths_to_be_of_use() -> None:
    assert len(PATHS) > 40


def test_no_question_needs_more_than_three_places() -> None:
    questions = {
        question: re.findall(r"`([\w./]+/[\w./]*|workflows)`", places) for question, places, _ in rows("places")
    }
    assert len(questions) > 35
    assert {question: places for question, places in questions.items() if not 1 <= len(places) <= 3} == {}


def test_stages_are_defined_where_the_page_says() -> None:
    registry = Registry()
    registry.add_module(stages, "pano-mvs")
    for name, place, _, record in rows("stages"):
        spec = registry.stages[name.strip("`")]
        assert spec.function.__module__.replace(".", "/") + ".py" == place.strip("`"), name
        assert spec.output.__name__ == record.strip("`"), name


def test_the_table_of_stages_has_all_of_quickstart_that_the_cloud_needs() -> None:
    used = [entry.spec.name for entry in open_session("quickstart").workflow.stages.values()]
    shown = [row[0].strip("`") for row in rows("stages")]
    end = used.index("fusion.vote") + 1
    assert shown[:end] == used[:end]


def test_a_stage_is_in_a_file_that_begins_as_its_name_does() -> None:
    """`depth.structure` was in a file of filters, and `views.nearest` in one of depth."""
    registry = Registry()
    registry.add_module(stages, "pano-mvs")
    for name, spec in registry.stages.items():
        folder, _, file = spec.function.__module__.removeprefix("pano_mvs.stages.").rpartition(".")
        assert (folder or file).startswith(name.partition(".")[0]), name
