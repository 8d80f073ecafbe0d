"""Values of plugins come through a door: loaded when they are used, and bad ones disable their own names only."""

from __future__ import annotations

import sys

import pytest

import pano_mvs
from pano_mvs.core.doors import Door, installed, is_bundled
from pano_mvs.core.errors import PluginError, UsageError
from pano_mvs.core.named_registry import registrations_of, set_unavailable
from tests.plugin_packages import Packages

LAMP = "def lamp():\n    return 'light'\n"


def lamps() -> Door[object]:
    return Door("lamp", "pano_mvs.lamps", {"candle": "wax"}, accepts=lambda value: value if callable(value) else None)


def test_a_module_is_imported_when_its_value_is_used(packages: Packages) -> None:
    packages.add(
        "shop", {"lamps": {"desk": "desk_lamp:lamp", "wall": "wall_lamp:lamp"}}, desk_lamp=LAMP, wall_lamp=LAMP
    )
    door = lamps()
    assert door.names() == ("candle", "desk", "wall")
    assert door.check("desk") == "desk"
    assert door.origin("desk") == "shop 1"
    assert "desk_lamp" not in sys.modules
    first = door.get("desk")
    assert first is door.get("desk") is sys.modules["desk_lamp"].lamp
    assert "wall_lamp" not in sys.modules


def test_a_module_that_fails_disables_its_own_names(packages: Packages) -> None:
    packages.add("dark", {"lamps": {"off": "dark_lamp:lamp", "gone": "dark_lamps:lamp"}}, dark_lamp="1 / 0\n")
    packages.add("shop", {"lamps": {"desk": "desk_lamp:lamp"}}, desk_lamp=LAMP)
    door = lamps()
    assert callable(door.get("desk"))
    for _ in range(2):
        with pytest.raises(PluginError, match=r"lamp 'off' of dark 1 .* dark_lamp:lamp failed to load: ZeroDivisionE"):
            door.get("off")
    assert "No module named 'dark_lamps'. Update or uninstall that plugin" in door.problem("gone")
    assert door.problem("desk") == door.problem("candle") == ""
    assert door.names() == ("candle", "desk", "gone", "off")


@pytest.mark.parametrize("ends", ["import sys\nsys.exit(3)\n", "raise BaseException\n", "def lamp(:\n"])
def test_however_a_module_fails_it_is_a_plugin_error(packages: Packages, ends: str) -> None:
    packages.add("dark", {"lamps": {"off": "dark_lamp:lamp"}}, dark_lamp=ends)
    with pytest.raises(PluginError, match="'off' of dark 1 cannot be used"):
        lamps().get("off")


def test_a_name_that_two_packages_offer_cannot_be_used(packages: Packages) -> None:
    packages.add("shop", {"lamps": {"desk": "desk_lamp:lamp", "wall": "desk_lamp:lamp"}}, desk_lamp=LAMP)
    packages.add("other-shop", {"lamps": {"desk": "other_lamp:lamp"}}, other_lamp=LAMP)
    door = lamps()
    assert door.names() == ("candle", "desk", "wall")
    both = r"lamp 'desk' is offered twice: by shop 1 \(desk_lamp:lamp\) and other-shop 1 \(other_lamp:lamp\)"
    with pytest.raises(PluginError, match=both):
        door.get("desk")
    assert door.origin("desk") == "shop 1 and other-shop 1"
    assert "desk_lamp" not in sys.modules
    assert callable(door.get("wall"))


def test_the_same_package_twice_on_the_path_is_one(packages: Packages) -> None:
    packages.add("shop", {"lamps": {"desk": "desk_lamp:lamp"}}, desk_lamp=LAMP)
    packages.add("shop-dev", {"lamps": {"desk": "desk_lamp:lamp"}})
    assert callable(lamps().get("desk"))


def test_an_object_of_another_kind_cannot_be_used(packages: Packages) -> None:
    packages.add("shop", {"lamps": {"desk": "desk_lamp:lamp"}}, desk_lamp="lamp = 'no function'\n")
    with pytest.raises(PluginError, match=r"'desk' of shop 1 cannot be used: desk_lamp:lamp is not a lamp\. Update"):
        lamps().get("desk")


def test_a_package_cannot_replace_what_is_built_in(packages: Packages) -> None:
    packages.add("shop", {"lamps": {"candle": "desk_lamp:lamp"}}, desk_lamp=LAMP)
    assert lamps().names() == ("candle",)
    assert (lamps().get("candle"), lamps().origin("candle")) == ("wax", "built in")


def test_a_package_cannot_take_the_name_of_a_bundled_plugin(packages: Packages) -> None:
    packages.add("pano-mvs", {"lamps": {"desk": "own_lamp:lamp"}}, own_lamp=LAMP)
    packages.add("shop", {"lamps": {"desk": "desk_lamp:lamp"}}, desk_lamp="1 / 0\n")
    assert callable(lamps().get("desk"))
    assert "desk_lamp" not in sys.modules


def test_a_bundled_plugin_whose_module_is_missing_disables_its_own_names(packages: Packages) -> None:
    """Whoever deletes the folder of a bundled plugin keeps its entry points until pano-mvs is installed again."""
    packages.add("pano-mvs", {"lamps": {"desk": "pano_mvs_lamps.desk:lamp", "wall": "desk_lamp:lamp"}}, desk_lamp=LAMP)
    door = lamps()
    missing = r"'desk' of pano_mvs_lamps cannot be used, .*No module named 'pano_mvs_lamps'\. Install pano-mvs again"
    with pytest.raises(PluginError, match=missing):
        door.get("desk")
    assert callable(door.get("wall"))
    assert all(is_bundled(entry) for entries in installed("pano_mvs.lamps").values() for entry in entries)


def test_what_a_module_prints_or_changes_does_not_stay(packages: Packages, capsys: pytest.CaptureFixture[str]) -> None:
    loud = "import locale, os\nprint('hello')\nos.environ['LAMP'] = 'on'\n"
    packages.add("shop", {"lamps": {"desk": "desk_lamp:lamp"}}, desk_lamp=loud + LAMP)
    import os

    lamps().get("desk")
    assert "LAMP" not in os.environ
    assert capsys.readouterr().out == ""


def test_a_file_cannot_take_the_name_of_a_package(packages: Packages) -> None:
    packages.add("shop", {"lamps": {"desk": "desk_lamp:lamp"}}, desk_lamp=LAMP)
    door = lamps()

    def lamp() -> None: ...

    with pytest.raises(PluginError, match="the lamp 'desk' is that of shop 1: register yours under another name"):
        door.register("desk", lamp, lamp)
    door.register("mine", lamp, lamp)
    assert door.names() == ("candle", "desk", "mine")
    assert door.get("mine") is lamp
    assert door.origin("mine") == __file__
    assert [found.name for found in registrations_of(lamp)] == ["mine"]


def test_a_package_may_register_what_its_entry_point_names(packages: Packages) -> None:
    door = lamps()
    packages.add("shop", {"lamps": {"desk": f"{__name__}:lamp"}})

    def lamp() -> None: ...

    door.register("desk", lamp, lamp)
    assert door.names() == ("candle", "desk")
    assert door.get("desk") is lamp


def test_a_name_that_two_files_register_cannot_be_used(packages: Packages) -> None:
    door = lamps()

    def lamp() -> None: ...

    door.register("desk", lamp, lamp)
    set_unavailable({("lamp", "desk"): "lamp 'desk' is defined twice: a.py:1 and b.py:1"}, [])
    with pytest.raises(PluginError, match=r"'desk' cannot be used: .* defined twice: a\.py:1 and b\.py:1"):
        door.get("desk")
    assert "defined twice" in door.problem("desk")


def test_an_unknown_name_lists_the_known_ones(packages: Packages) -> None:
    packages.add("shop", {"lamps": {"desk": "desk_lamp:lamp"}})
    with pytest.raises(UsageError, match=r"there is no lamp 'disk'; did you mean 'desk'\? known: candle, desk"):
        lamps().get("disk")


def test_functions_of_packages_are_names_of_pano_mvs(packages: Packages) -> None:
    packages.add("shop", {"functions": {"enlighten": "desk_lamp:lamp", "darken": "dark_lamp:lamp"}}, desk_lamp=LAMP)
    assert {"enlighten", "darken"} <= set(dir(pano_mvs))
    assert pano_mvs.enlighten() == "light"
    with pytest.raises(PluginError, match="function 'darken' of shop 1 cannot be used"):
        pano_mvs.darken()
    with pytest.raises(AttributeError, match="no attribute 'dazzle'"):
        pano_mvs.dazzle()
