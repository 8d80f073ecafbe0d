"""Combinations of settings: a grid from options, or a grid, a list or random draws from a file."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import InputError, UsageError, WorkflowError
from pano_mvs.core.file_names import is_plain_name
from pano_mvs.core.files import read_regular
from pano_mvs.core.paths import reason_of
from pano_mvs.core.yaml_text import Located, Problems, did_you_mean, parse_yaml

MAX_COMBINATIONS = 10_000
_SYNTAX = "write STAGE.PARAM=V1,V2, such as depth.planes=64,128"
_CLOSING = {"[": "]", "{": "}"}
_KEYS = ("grid", "list", "random")
_RANGE_KEYS = ("min", "max", "log", "integer")
_MAX_NAME = 60


@dataclass(frozen=True, slots=True)
class Value:
    """A value of a setting."""

    text: str  # as `--set` takes it
    place: str  # where it is written: an option, an argument, or `file:line:column`

    @property
    def shown(self) -> str:
        """The value in a table."""
        return self.text or "null"


Combination = Mapping[str, Value]
"""`STAGE.PARAM` to its value."""


def items_of(text: str) -> list[str]:
    """Return the values in a text with commas; text in brackets or quotes is one value.

    >>> items_of("64, [1, 2], 'a,b'")
    ['64', '[1, 2]', "'a,b'"]

    Raises:
        ValueError: if a bracket or a quote is not closed, or there is nothing between two commas.
    """
    found, begin, idx = [], 0, 0
    while idx < len(text):
        if not text[begin:idx].strip() and text[idx] in "[{\"'":
            idx = _end_of(text, idx)
        elif text[idx] == ",":
            found.append(text[begin:idx].strip())
            begin = idx = idx + 1
        else:
            idx += 1
    found.append(text[begin:].strip())
    if len(found) > 1 and "" in found:
        raise ValueError("there is no value beside a comma; write null for no value")
    return found


def _end_of(text: str, begin: int) -> int:
    """Return the position after the quoted or bracketed value that begins at a position."""
    open_brackets, idx = list[str](), begin
    while idx < len(text):
        sign = text[idx]
        if sign in "\"'" and (idx == begin or text[:idx].rstrip()[-1:] in tuple("[{,:")):
            idx = _end_of_quote(text, idx)
        else:
            if sign in _CLOSING:
                open_brackets.append(_CLOSING[sign])
            elif open_brackets and sign == open_brackets[-1]:
                open_brackets.pop()
            idx += 1
        if not open_brackets:
            return idx
    raise ValueError(f"{open_brackets[-1]} is missing")


def _end_of_quote(text: str, begin: int) -> int:
    quote, idx = text[begin], begin + 1
    while idx < len(text):
        is_escape = text[idx] == "\\" if quote == '"' else text[idx : idx + 2] == "''"
        if is_escape:
            idx += 2
        elif text[idx] == quote:
            return idx + 1
        else:
            idx += 1
    raise ValueError(f"the closing {quote} is missing")


def grid_from_options(options: Sequence[str]) -> dict[str, list[Value]]:
    """Return the values of each setting in options `STAGE.PARAM=V1,V2`, by `STAGE.PARAM`.

    Raises:
        WorkflowError: with each option that cannot be read, or that sets what another one sets.
    """
    found: dict[str, list[Value]] = {}
    problems = Problems()
    for option in options:
        target, equals, written = option.partition("=")
        target, place = target.strip(), f"--set {option[:80]}"
        if not (equals and target):
            problems.add(place, _SYNTAX)
        elif target in found:
            problems.add(place, f"{target} is set twice; write all its values in one option, with commas")
        else:
            origin = f"--set {target}"
            try:
                items = [_text_of_item(item, origin) for item in items_of(written)]
            except WorkflowError as error:
                problems.lines.extend(error.problems)
            except ValueError as error:
                problems.add(place, str(error))
            else:
                is_removal = "." not in target  # STAGE=null
                found[target] = [Value("null" if is_removal and not text else text, origin) for text in items]
    problems.raise_if_any()
    return found


def _text_of_item(item: str, origin: str) -> str:
    """Return an item as `--set` takes it: without the quotes if these do not change the value."""
    return text_from_value(parse_yaml(item, origin).plain()) if item[:1] in tuple("\"'") else _null_as_nothing(item)


def _null_as_nothing(item: str) -> str:
    return "" if item in ("null", "~") else item  # null would be the name of a file


def text_from_value(value: object) -> str:
    """Return a value as `--set` takes it.

    >>> [text_from_value(value) for value in (64, "census", "64", None, [1, 2], "a,b")]
    ['64', 'census', '"64"', '', '[1, 2]', 'a,b']
    """
    if value is None:
        return ""
    if isinstance(value, str) and _is_plain(value):
        return value
    return json.dumps(value, ensure_ascii=False)


def _is_plain(text: str) -> bool:
    """Return whether YAML reads a text as this text."""
    try:
        return bool(parse_yaml(text, "").value == text)
    except WorkflowError:
        return False


def combinations_of_grid(values: Mapping[str, Sequence[Value]]) -> list[dict[str, Value]]:
    """Return all combinations of the values of settings; those of the last setting vary fastest.

    Raises:
        UsageError: if there are too many.
    """
    count = math.prod(map(len, values.values()))
    if count > MAX_COMBINATIONS:
        sizes = " × ".join(str(len(each)) for each in values.values())
        raise UsageError(
            f"{', '.join(values)}: {sizes} makes {count} combinations, and at most {MAX_COMBINATIONS} are possible. "
            "Give fewer values, or draw combinations at random"
        )
    return [dict(zip(values, chosen, strict=True)) for chosen in product(*values.values())]


def combinations_from_file(path: Path) -> list[dict[str, Value]]:
    """Return the combinations in a YAML file with one of the keys `grid`, `list` and `random`.

    Raises:
        InputError: if the file cannot be read.
        WorkflowError: with every mistake in it and its place.
    """
    try:
        text = read_regular(path).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot be read ({reason_of(error)}). Give a YAML file with grid, list or random"
        ) from error
    return combinations_from_yaml(parse_yaml(text, str(path)))


def combinations_from_yaml(root: Located) -> list[dict[str, Value]]:
    """Return the combinations in a document with one of the keys `grid`, `list` and `random`.

    Raises:
        WorkflowError: with every mistake in it and its place.
    """
    problems = Problems()
    entries = _mapping(root, problems, "grid: {depth.planes: [64, 128]}, list: or random:")
    for key, node in entries.items():
        if key not in _KEYS:
            problems.add(node.key_place, f"unknown key {key[:80]!r}.{did_you_mean(key, _KEYS)}")
    known = [key for key in _KEYS if key in entries]
    if len(known) != 1 and not problems.lines:
        problems.add(root.place, f"give one of the keys {', '.join(_KEYS)}, not {' and '.join(known) or 'nothing'}")
    problems.raise_if_any()
    read = {"grid": _grid, "list": _list, "random": _random}[known[0]]
    found = read(entries[known[0]], problems)
    problems.raise_if_any()
    if not found:
        raise WorkflowError([f"{entries[known[0]].place}: {known[0]} holds no combination"])
    return found


def _grid(node: Located, problems: Problems) -> list[dict[str, Value]]:
    values = {
        target: [_value(item) for item in _choices(each, problems)]
        for target, each in _mapping(node, problems, "{depth.planes: [64, 128]}").items()
    }
    return [] if problems.lines else combinations_of_grid(values) if values else []


def _list(node: Located, problems: Problems) -> list[dict[str, Value]]:
    if not isinstance(node.value, list):
        problems.add(node.place, "must be a list of combinations, such as [{depth.planes: 64}, {depth.planes: 128}]")
        return []
    return [
        {target: _value(value) for target, value in _mapping(item, problems, "{depth.planes: 64}").items()}
        for item in node.value
    ]


def _random(node: Located, problems: Problems) -> list[dict[str, Value]]:
    """Return combinations whose settings are drawn independently of each other.

    A larger count adds combinations, and a further setting does not change the draws of the others.
    """
    entries = _mapping(node, problems, "{count: 10, seed: 0, settings: {depth.planes: [64, 128]}}")
    for key, value in entries.items():
        if key not in ("count", "seed", "settings"):
            problems.add(value.key_place, f"unknown key {key[:80]!r}. Known: count, seed, settings")
    count = _whole(entries.get("count"), node, problems, name="count", least=1, most=MAX_COMBINATIONS)
    seed = _whole(entries.get("seed"), node, problems, name="seed", least=0, most=2**63 - 1, default=0)
    if "settings" not in entries:
        problems.add(node.place, "settings are missing: {depth.planes: [64, 128], depth.p1: {min: 10, max: 100}}")
        return []
    draws = {
        target: _draws(each, problems, count=count, seed=[seed, int(digest_from_value(target), 16)])
        for target, each in _mapping(entries["settings"], problems, "{depth.planes: [64, 128]}").items()
    }
    return (
        []
        if problems.lines or not draws
        else [{target: draws[target][idx] for target in draws} for idx in range(count)]
    )


def _draws(node: Located, problems: Problems, *, count: int, seed: Sequence[int]) -> list[Value]:
    """Return values drawn from a list of choices, or from a range `{min: , max: , log: , integer: }`."""
    rng = np.random.default_rng(seed)
    if not isinstance(node.value, dict):
        choices = _choices(node, problems)
        return [_value(choices[int(idx)]) for idx in rng.integers(0, max(1, len(choices)), count)] if choices else []
    for key, value in node.value.items():
        if key not in _RANGE_KEYS:
            problems.add(value.key_place, f"unknown key {key[:80]!r}. Known: {', '.join(_RANGE_KEYS)}")
    low, high = _number(node, "min", problems), _number(node, "max", problems)
    is_log, is_whole = (_flag(node, key, problems) for key in ("log", "integer"))
    if not (math.isfinite(low) and math.isfinite(high)):
        return []
    if low > high or (is_log and low <= 0) or (is_whole and math.floor(high) < math.ceil(low)):
        needed = "min above 0 and not above max" if is_log else "min not above max"
        problems.add(node.place, f"needs {needed}{', with a whole number between them' if is_whole else ''}")
        return []
    shares = rng.random(count)
    drawn = low * (high / low) ** shares if is_log else low + (high - low) * shares
    if is_whole:
        least, most = math.ceil(low), math.floor(high)
        # Of equal weight without `log`: each whole number stands for an interval of the same length.
        whole = np.round(drawn) if is_log else least + np.floor(shares * (most - least + 1))
        return [Value(str(int(number)), node.place) for number in np.clip(whole, least, most)]
    return [Value(f"{number:.4g}", node.place) for number in np.clip(drawn, low, high)]


def _value(node: Located) -> Value:
    return Value(text_from_value(node.plain()), node.place)


def _mapping(node: Located, problems: Problems, example: str) -> dict[str, Located]:
    if not isinstance(node.value, dict):
        problems.add(node.place, f"must be a mapping, such as {example}")
        return {}
    return node.value


def _choices(node: Located, problems: Problems) -> list[Located]:
    if not isinstance(node.value, list) or not node.value:
        problems.add(node.place, "must be a list of values, such as [64, 128]")
        return []
    return node.value


def _number(node: Located, key: str, problems: Problems) -> float:
    found = node.value.get(key)
    if found is None or isinstance(found.value, bool) or not isinstance(found.value, int | float):
        problems.add((found or node).place, f"{key} must be a number: give a list of values, or {{min: 1, max: 10}}")
        return math.nan
    return float(found.value)


def _flag(node: Located, key: str, problems: Problems) -> bool:
    found = node.value.get(key)
    if found is not None and not isinstance(found.value, bool):
        problems.add(found.place, f"{key} must be true or false")
    return found is not None and found.value is True


def _whole(
    node: Located | None,
    above: Located,
    problems: Problems,
    *,
    name: str,
    least: int,
    most: int,
    default: int | None = None,
) -> int:
    if node is None and default is not None:
        return default
    value: Any = None if node is None else node.value
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        problems.add((node or above).place, f"{name} must be a whole number from {least} to {most}")
        return least
    return value


def located(value: object, origin: str) -> Located:
    """Return a value of Python as if it were written in a file; messages show `origin` as its place."""
    if isinstance(value, Mapping):
        inner: Any = {str(key): located(each, f"{origin}[{str(key)!r}]") for key, each in value.items()}
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes):
        inner = [located(each, origin) for each in value]
    elif isinstance(value, Path):
        inner = str(value)
    else:
        inner = item() if callable(item := getattr(value, "item", None)) else value  # scalars of numpy
        if not (inner is None or isinstance(inner, bool | int | float | str)):
            raise UsageError(f"{origin}: a {type(value).__name__} is not a value of a setting")
    return Located(inner, 0, 0, origin=origin)


def short_keys(targets: Sequence[str]) -> dict[str, str]:
    """Return a short name of each setting: PARAM, or STAGE.PARAM where two stages have one of that name.

    >>> short_keys(["depth.planes", "views.sources", "checked.sources"])
    {'depth.planes': 'planes', 'views.sources': 'views.sources', 'checked.sources': 'checked.sources'}
    """
    last = [target.rpartition(".")[2] for target in targets]
    return {
        target: name if last.count(name) == 1 and name not in ("seed", "use") else target
        for target, name in zip(targets, last, strict=True)
    }


def names_of(combinations: Sequence[Combination]) -> list[str]:
    """Return a name of each combination that is a valid and readable name of a folder: `planes=64,cost=census`.

    A long name, or one with characters that are not safe, is cut and ends with a digest.
    """
    keys = short_keys(list(dict.fromkeys(target for each in combinations for target in each)))
    names = [_name(each, keys) for each in combinations]
    texts: dict[str, set[str]] = {}
    for name, each in zip(names, combinations, strict=True):
        texts.setdefault(name, set()).add(_digest(each))
    return [
        _with_digest(name, each) if len(texts[name]) > 1 else name
        for name, each in zip(names, combinations, strict=True)
    ]


def _name(combination: Combination, keys: Mapping[str, str]) -> str:
    if not combination:
        return "default"
    name = ",".join(f"{keys[target]}={value.shown}" for target, value in combination.items())
    parts = [*combination, *(value.shown for value in combination.values())]
    is_safe = all(is_plain_name(f"a{part}a") for part in parts)
    # Some file systems do not distinguish upper and lower case.
    is_safe = is_safe and name == name.casefold() and not name.endswith(".") and name.isascii()
    return name if is_safe and len(name) <= _MAX_NAME else _with_digest(name, combination)


def _with_digest(name: str, combination: Combination) -> str:
    kept = "".join(sign if sign.isascii() and (sign.isalnum() or sign in "-_.=,") else "_" for sign in name)
    return f"{kept[: _MAX_NAME - 9].strip('.,=_-').lower() or 'settings'}-{_digest(combination)}"


def _digest(combination: Combination) -> str:
    return digest_from_value({target: value.text for target, value in combination.items()})[:8]
