"""What counts as the code of a part that comes from an installed package."""

from __future__ import annotations

from pathlib import Path

from pano_mvs.engine.code.plugin_digest import code_digest


def package(folder: Path, *, constant: int = 1, beside: int = 1) -> Path:
    """Write a package whose module imports another of its own, relative and absolute, and what is beside it."""
    files = {
        "mine/__init__.py": "from mine.inner.work import x\n",
        "mine/inner/__init__.py": "import beside\nfrom mine import numbers\n",
        "mine/inner/work.py": "x = 1\n",
        "mine/numbers.py": f"constant = {constant}\n",
        "beside/__init__.py": f"other = {beside}\n",
    }
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder / "mine" / "__init__.py"


def test_all_of_a_package_that_is_used_counts_and_nothing_beside_it(tmp_path: Path) -> None:
    before = code_digest(package(tmp_path / "a"))
    assert code_digest(package(tmp_path / "a", beside=2)) == before
    assert code_digest(package(tmp_path / "a", constant=2)) != before


def test_the_folder_into_which_a_package_is_installed_does_not_count(tmp_path: Path) -> None:
    assert code_digest(package(tmp_path / "a")) == code_digest(package(tmp_path / "elsewhere" / "b"))


def test_a_module_inside_a_package_finds_what_it_imports_by_its_full_name(tmp_path: Path) -> None:
    inner = package(tmp_path / "a").parent / "inner" / "__init__.py"
    before = code_digest(inner)
    package(tmp_path / "a", constant=2)
    assert code_digest(inner) != before
