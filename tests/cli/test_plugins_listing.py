"""`pano-mvs plugins`: one row for each plugin, with all that it brings."""

from __future__ import annotations

import sys
from pathlib import Path

from tests.cli.conftest import Command
from tests.cli.test_plugin_commands import HELLO
from tests.plugin_packages import Packages

STAGE = '''\
from pano_mvs.api import Each, RangeMap, register_sweep_cost, stage


@stage("filters.{name}")
def same(x: Each[RangeMap]) -> RangeMap:
    """As it is."""
    return x
'''


def rows(text: str) -> dict[str, list[str]]:
    """Return the cells of the first table by the name of the plugin, which may be cut."""
    lines = [line.strip("│ ").split("│") for line in text.partition("stage")[0].splitlines() + text.splitlines()]
    return {cells[0].strip(): [cell.strip() for cell in cells[1:]] for cells in lines if len(cells) == 4}


def test_the_core_has_a_row(pano_mvs: Command, packages: Packages) -> None:
    result = pano_mvs("plugins", "--check")
    assert result.code == 0, result.text
    (core,) = (cells for name, cells in rows(result.text).items() if name.startswith("pano-mvs "))
    assert core[:2] == ["built in", "ok"]
    assert core[2].endswith(" stages")
    assert "likewise" not in result.text


def test_files_and_packages_have_a_row_each(pano_mvs: Command, mine: Path, packages: Packages) -> None:
    packages.add(
        "shop",
        {
            "plugins": {"a": "shop_stages", "b": "shop_more"},
            "commands": {"shine": "shop_doors:shine", "cache.shine": "shop_doors:shine"},
            "functions": {"enlighten": "shop_doors:shine"},
        },
        shop_stages=STAGE.format(name="shop"),
        shop_more=STAGE.format(name="more"),
        shop_doors="def shine(): ...\n",
    )
    (mine / "hello.py").write_text(HELLO.format(name="hello"))
    result = pano_mvs("plugins")
    assert result.code == 0
    found = rows(result.text)
    assert found["shop 1"] == [
        "installed",
        "ok",
        "stages filters.more, filters.shop; commands cache.shine, shine; function enlighten",
    ]
    assert "shop_doors" not in sys.modules
    assert [cells for name, cells in found.items() if cells[0] == "file"] == [["file", "ok", "command hello"]]
    assert pano_mvs("plugins", "--check").code == 0
    assert "shop_doors" in sys.modules


def test_broken_plugins_are_named_once_with_the_reason(pano_mvs: Command, mine: Path, packages: Packages) -> None:
    names = {"one": "dark:one", "two": "dark:two", "three": "dark:three"}
    packages.add("dark", {"commands": names, "observers": {"four": "dark:four"}}, dark="1 / 0\n")
    packages.add("shop", {"commands": {"shine": "json:dumps"}})
    packages.add("other", {"commands": {"shine": "json:loads"}})
    (mine / "bad.py").write_text("LIMIT = {}[3]\n")
    result = pano_mvs("plugins")
    assert result.code == 0
    assert rows(result.text)["dark 1"][1] == "ok"  # as far as is known
    assert rows(result.text)["shop 1"][1] == rows(result.text)["other 1"][1] == "broken"
    assert result.flat.count("command 'shine' is offered twice: by shop 1 (json:dumps) and other 1 (json:loads)") == 1
    assert result.flat.count("bad.py failed to load") == 1
    result = pano_mvs("plugins", "--check")
    assert result.code == 2
    assert rows(result.text)["dark 1"] == ["installed", "broken", "commands one, three, two; observer four"]
    assert result.flat.count("ZeroDivisionError") == 1
    assert "likewise: command three, command two, observer four" in result.flat
