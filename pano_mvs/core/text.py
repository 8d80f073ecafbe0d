"""Make text of files, plugins and exceptions safe to print: not too long, and without control characters; XML."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from xml.etree import ElementTree

# Control characters except tab and newline, marks of writing direction, line separators, surrogates.
_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def shortened(text: str, most: int = 2000) -> str:
    """Return a text shortened to about `most` characters: its beginning, the number of omitted ones, and its end.

    >>> shortened("a" * 10 + "b" * 90, 20)
    'aaaaaaaaaabbbbb … (80 characters left out) … bbbbb'
    """
    text = str.__str__(text)  # a subclass may state another length
    if len(text) <= most:
        return text
    end = most // 4
    return f"{text[: most - end]} … ({len(text) - most} characters left out) … {text[-end:]}"


def error_text(error: BaseException) -> str:
    """Return the message of an exception, shortened; a replacement if the exception fails to make its message."""
    try:
        return shortened(str(error))
    except BaseException as second:
        return f"(its message cannot be shown: {type(second).__name__})"


def error_summary(error: BaseException) -> str:
    """Return the class and the message of an error in one line."""
    return " ".join(f"{type(error).__name__}: {error_text(error)}".split())


def plural(count: int, one: str, many: str = "") -> str:
    """Return the singular or plural of a word or phrase for a count; `many` defaults to `one` with an s.

    >>> [f"{count} {plural(count, 'file')} {plural(count, 'is', 'are')} left" for count in (0, 1, 2)]
    ['0 files are left', '1 file is left', '2 files are left']
    """
    return one if count == 1 else many or f"{one}s"


def shortened_list(names: Iterable[str], count: int = 3, *, rest: str = " … ({total} in all)") -> str:
    """Return the first names as text, followed by `rest` if there are more.

    >>> shortened_list("abcde")
    'a, b, c … (5 in all)'
    >>> shortened_list("abcde", rest=" and {more} more")
    'a, b, c and 2 more'
    """
    listed = list(names)
    left = len(listed) - count
    return ", ".join(listed[:count]) + (rest.format(total=len(listed), more=left) if left > 0 else "")


def duration_text(seconds: float) -> str:
    """Return a duration as text, rounded.

    >>> [duration_text(seconds) for seconds in (0.4, 5, 119, 600, 9000)]
    ['0.4 s', '5 s', '119 s', '10 min', '2.5 h']
    """
    if seconds < 0.95:
        return f"{seconds:.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 90 * 60 else f"{seconds / 3600:.1f} h"


def clock_text(seconds: float) -> str:
    """Return a duration as a clock shows it, so that every second is seen.

    >>> [clock_text(seconds) for seconds in (5, 75.8, 3675)]
    ['0:05', '1:15', '1:01:15']
    """
    minutes, rest_s = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest_s:02d}" if hours else f"{minutes}:{rest_s:02d}"


def without_controls(text: str) -> str:
    r"""Return a text with control characters escaped, so that a terminal shows them and does not execute them.

    >>> without_controls("a\x1b[31m.jpg")
    'a\\x1b[31m.jpg'
    """
    return _CONTROLS.sub(lambda match: _escaped(match[0]), text)


def one_line(text: str) -> str:
    r"""Return a text with control characters, tabs and newlines escaped, for one line.

    >>> one_line("a\nb.jpg")
    'a\\x0ab.jpg'
    """
    return without_controls(text).replace("\t", _escaped("\t")).replace("\n", _escaped("\n"))


def json_without_controls(line: str) -> str:
    """Return a line of JSON with the control characters that JSON permits in strings escaped."""
    return _CONTROLS.sub(lambda match: f"\\u{ord(match[0]):04x}", line)


def _escaped(sign: str) -> str:
    return f"\\x{ord(sign):02x}" if ord(sign) < 256 else f"\\u{ord(sign):04x}"


def xml_root(data: bytes) -> ElementTree.Element:
    """Return the root of an XML document.

    Raises:
        ValueError: if it is not well-formed, or declares entities, which could expand without limit.
    """
    plain = data.replace(b"\0", b"").upper()  # of UTF-16, too
    if b"<!DOCTYPE" in plain or b"<!ENTITY" in plain:
        raise ValueError("it declares XML entities")
    try:
        return ElementTree.fromstring(data)  # noqa: S314  # without entities
    except (ElementTree.ParseError, LookupError) as error:  # LookupError: an encoding that nobody knows
        raise ValueError(f"not an XML file ({error})") from error


def finite_or_none(value: float) -> float | None:
    """Return a number for JSON, which has no NaN and no infinity."""
    return float(value) if math.isfinite(value) else None
