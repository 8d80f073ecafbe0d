"""Text that is safe to print, work in bands, and libraries that extras install."""

from __future__ import annotations

import json
import json.decoder
import re
import sys

import pytest

from pano_mvs.core.bands import for_bands
from pano_mvs.core.errors import UsageError
from pano_mvs.core.extras import import_extra
from pano_mvs.core.text import json_without_controls, one_line, shortened, without_controls


def test_long_texts_keep_their_beginning_and_end() -> None:
    cut = shortened("<" + "x" * 1_000_000 + ">")
    assert len(cut) < 2100
    assert cut.startswith("<xx")
    assert cut.endswith("xx>")
    assert "998002 characters left out" in cut


def test_a_text_that_states_another_length_is_shortened() -> None:
    """The message of a plugin's exception may be one."""

    class Short(str):
        __slots__ = ()

        def __len__(self) -> int:
            return 1

    assert len(shortened(Short("x" * 1_000_000))) < 2100


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a\x1b[2Jb", "a\\x1b[2Jb"),
        ("a\x9b31mb", "a\\x9b31mb"),
        ("a\rb\x07\x7f", "a\\x0db\\x07\\x7f"),
        ("gpj.\u202eb", "gpj.\\u202eb"),
        ("a\udc80b", "a\\udc80b"),
    ],
)
def test_what_would_steer_a_terminal_is_spelled_out(text: str, shown: str) -> None:
    assert without_controls(text) == shown
    line = json_without_controls(json.dumps(text, ensure_ascii=False))
    assert without_controls(line) == line
    assert json.loads(line) == text


def test_a_name_stays_on_its_line() -> None:
    """A file name with a newline could print a line of its own, such as "results in …"."""
    assert one_line("x\nresults in\there\x1b.jpg") == r"x\x0aresults in\x09here\x1b.jpg"
    assert one_line("räume/1.jpg") == "räume/1.jpg"


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("height", [0, 1, 32, 33, 200])
def test_bands_cover_every_row_once(height: int, threads: int) -> None:
    bands: list[tuple[int, int]] = []
    for_bands(lambda first, rows: bands.append((first, rows)), height, threads=threads)
    covered = [row for first, rows in bands for row in range(first, first + rows)]
    assert sorted(covered) == list(range(height))


@pytest.mark.parametrize("threads", [1, 3])
def test_an_error_in_a_band_is_raised(threads: int) -> None:
    def fail(first: int, rows: int) -> None:
        if first:
            raise ValueError(f"row {first}")

    with pytest.raises(ValueError, match="row 32"):
        for_bands(fail, 64, threads=threads)


def test_module_is_returned() -> None:
    assert import_extra("json.decoder", "--json", "json") is json.decoder


def test_missing_library_is_refused_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rocrate.rocrate", None)
    with pytest.raises(UsageError, match=re.escape("pano-mvs crate needs rocrate: pip install 'pano-mvs[crate]'")):
        import_extra("rocrate.rocrate", "pano-mvs crate", "crate")
