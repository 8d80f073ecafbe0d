"""Text of files, plugins and exceptions: cut to a length that can be read, and without control characters."""

from __future__ import annotations

import re

MAX_CHARACTERS = 2000
"""The length of a message; what is longer is a dump."""

# Control characters but tab and newline, marks that turn the direction of writing, line separators, surrogates.
_STEERING = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def shortened(text: str, most: int = MAX_CHARACTERS) -> str:
    """Return a text of about `most` characters: its beginning and its end, with how many are left out between.

    >>> shortened("a" * 10 + "b" * 90, 20)
    'aaaaaaaaaabbbbb … (80 characters left out) … bbbbb'
    """
    if len(text) <= most:
        return text
    end = most // 4
    return f"{text[: most - end]} … ({len(text) - most} characters left out) … {text[-end:]}"


def plural(count: int, one: str, many: str = "") -> str:
    """Return the form of a word, or of a few, that goes with a count; `many` is by default `one` with an s.

    >>> [f"{count} {plural(count, 'file')} {plural(count, 'is', 'are')} left" for count in (0, 1, 2)]
    ['0 files are left', '1 file is left', '2 files are left']
    """
    return one if count == 1 else many or f"{one}s"


def without_controls(text: str) -> str:
    r"""Return a text in which control characters are spelled out, so that a terminal shows them and obeys none.

    >>> without_controls("a\x1b[31m.jpg")
    'a\\x1b[31m.jpg'
    """
    return _STEERING.sub(lambda match: _spelled(match[0]), text)


def one_line(text: str) -> str:
    r"""Return a name as `without_controls` does, on one line: tabs and newlines are spelled out, too.

    >>> one_line("a\nb.jpg")
    'a\\x0ab.jpg'
    """
    return without_controls(text).replace("\t", _spelled("\t")).replace("\n", _spelled("\n"))


def json_without_controls(line: str) -> str:
    """Return a line of JSON in which the control characters that JSON permits in strings are written as escapes."""
    return _STEERING.sub(lambda match: f"\\u{ord(match[0]):04x}", line)


def _spelled(sign: str) -> str:
    return f"\\x{ord(sign):02x}" if ord(sign) < 256 else f"\\u{ord(sign):04x}"
