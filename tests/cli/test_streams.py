"""A closed pipe or a full standard output ends the printing, not the command.

What the commands print of names, notes and exceptions.
"""

from __future__ import annotations

import errno
import io
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.console import Console
from pano_mvs.cli.streams import CLOSED_PIPE, LenientStream, StreamState, apart
from tests.engine.conftest import Toy

ON_POSIX = pytest.mark.skipif(os.name != "posix", reason="descriptors as POSIX has them")
FULL = Path("/dev/full")
ON_LINUX = pytest.mark.skipif(not FULL.exists(), reason="a device that is always full is Linux's")


class Refusing(io.RawIOBase):
    """A raw stream every write to which fails."""

    def __init__(self, number: int, *, is_terminal: bool = False) -> None:
        self.number = number
        self.is_terminal = is_terminal
        self.tries = 0

    def writable(self) -> bool:
        return True

    def isatty(self) -> bool:
        return self.is_terminal

    def write(self, data: object, /) -> int:
        self.tries += 1
        raise OSError(self.number, os.strerror(self.number))


@pytest.mark.parametrize(
    ("number", "is_terminal"), [(errno.EPIPE, False), (errno.ECONNRESET, False), (errno.EIO, True)]
)
def test_a_reader_that_leaves_ends_the_printing(number: int, is_terminal: bool) -> None:
    raw, state = Refusing(number, is_terminal=is_terminal), StreamState()
    stream = LenientStream(raw, "utf-8", state)
    for _ in range(3):
        print("a line", file=stream)
    stream.close()
    assert (state.reader_left, state.failure, raw.tries) == (True, "", 1)
    assert [state.exit_code(code) for code in (0, 2, 3)] == [CLOSED_PIPE, 2, 3]
    state.reader_may_leave = True
    assert state.exit_code(0) == 0


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO, errno.EBADF])
def test_an_output_that_cannot_be_written_is_reported(number: int, capsys: pytest.CaptureFixture[str]) -> None:
    state = StreamState()
    print("a line", file=LenientStream(Refusing(number), "utf-8", state))
    assert (state.reader_left, state.failure) == (False, os.strerror(number))
    assert [state.exit_code(code) for code in (0, 3)] == [4, 3]
    assert f"cannot be written: {os.strerror(number)}" in capsys.readouterr().err


@ON_POSIX
def test_all_is_written_to_a_pipe_that_is_full_and_does_not_block() -> None:
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)
    text = "x" * 1_000_000
    with subprocess.Popen(
        [sys.executable, "-c", "import sys, time; time.sleep(0.1); print(len(sys.stdin.read()))"],
        stdin=read_end,
        stdout=subprocess.PIPE,
        text=True,
    ) as reader:
        os.close(read_end)
        stream = LenientStream(io.FileIO(write_end, "w"), "utf-8", StreamState(), owned=True)
        stream.write(text)
        stream.close()
        assert reader.stdout is not None
        assert int(reader.stdout.read()) == len(text)


@ON_POSIX
def test_a_stream_apart_is_closed_with_its_own_descriptor_and_shares_the_state() -> None:
    read_end, write_end = os.pipe()
    state = StreamState()
    stream = LenientStream(io.FileIO(write_end, "w"), "utf-8", state, owned=True)
    other = apart(stream)
    print("one", file=other)
    other.close()
    print("two", file=stream)
    assert os.read(read_end, 100) == b"one\ntwo\n"
    os.close(read_end)
    print("three", file=stream)
    stream.close()
    assert (state.reader_left, state.reader_may_leave) == (True, True)


def command(*arguments: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
    done: subprocess.CompletedProcess[str] = subprocess.run(
        [sys.executable, "-m", "pano_mvs", *map(str, arguments)],
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        **options,
    )
    return done


def closed_pipe() -> int:
    read_end, write_end = os.pipe()
    os.close(read_end)
    return write_end


@ON_POSIX
def test_a_command_whose_reader_left_ends_as_if_by_sigpipe() -> None:
    ended = command("--version", stdout=closed_pipe())
    assert (ended.returncode, ended.stderr) == (128 + signal.SIGPIPE, "")


@ON_LINUX
@pytest.mark.slow
def test_a_command_reports_that_its_output_is_full() -> None:
    with FULL.open("w") as full:
        ended = command("plugins", stdout=full)
    assert ended.returncode == 4
    assert "No space left on device" in ended.stderr
    assert "Traceback" not in ended.stderr


@ON_POSIX
@pytest.mark.slow
@pytest.mark.parametrize(("option", "number", "code"), [("--json", "13", 3), ("--keep-going", "30", 0)])
def test_a_run_whose_reader_left_goes_on_to_its_end(toy: Toy, option: str, number: str, code: int) -> None:
    toy.number("3.txt", number)
    ended = command(
        "run", toy.folder / "wf.yaml", "--out", toy.folder / "out", "--executor", "serial", option, stdout=closed_pipe()
    )
    assert (ended.returncode, ended.stderr) == (code, "")
    assert {"report.html", "all.txt"} <= {path.name for path in (toy.folder / "out").iterdir()}


@ON_LINUX
@pytest.mark.slow
def test_a_run_whose_output_is_full_goes_on_to_its_end(toy: Toy) -> None:
    with FULL.open("w") as full:
        ended = command("run", toy.folder / "wf.yaml", "--out", toy.folder / "out", "--json", stdout=full)
    assert ended.returncode == 4
    assert (toy.folder / "out" / "report.html").is_file()


@ON_POSIX
@pytest.mark.slow
def test_closed_descriptors_are_not_given_to_other_files(toy: Toy) -> None:
    """Without an open descriptor 1, the first file that is opened would get what the stages print."""
    toy.edit("plug.py", lambda text: text.replace('"""Multiply."""', '"""Multiply."""\n    os.write(1, b"noise")'))
    shell = f"{sys.executable} -m pano_mvs run wf.yaml --executor serial >&- 2>&- <&-"
    assert subprocess.run(["/bin/sh", "-c", shell], cwd=toy.folder, check=False).returncode == 0
    assert (toy.folder / "out" / "toy" / "logs" / "scaled" / "3.txt.log").read_text() == "noise"


HOSTILE = "000\x1b[2J\x1b]0;owned\x07\x9b31m.jpg"


def printed(*things: object, terminal: bool = True) -> str:
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=terminal, color_system="standard", width=80)
    for thing in things:
        console.print(thing, highlight=False, soft_wrap=True)
    return stream.getvalue()


def test_control_characters_are_shown_and_colours_are_ours() -> None:
    text = printed(f"[red]failed:[/] {escape(HOSTILE)}")
    assert text.startswith("\x1b[31mfailed:\x1b[0m 000\\x1b[2J\\x1b]0;owned")
    assert text.count("\x1b") == 2
    assert "\x9b" not in text


def test_tables_are_safe_too() -> None:
    table = Table("image")
    table.add_row(escape(HOSTILE))
    assert "\x1b[2J" not in printed(table)
    assert "000\\x1b[2J" in printed(table)


def test_a_megabyte_is_not_printed() -> None:
    assert len(printed("x" * 1_000_000, terminal=False)) < 11_000
