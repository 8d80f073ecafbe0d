"""Lay out a workflow file: the order of keys, one line for a stage where it fits, no needless quotes, all comments.

Comments stay before the key that they precede, or behind the entry that they follow. A group of stages takes several
lines unless it has at most one stage. Another entry with comments inside, or with anchors, aliases or tags, stays as it
is written.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

from ruamel.yaml import YAML
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from pano_mvs.core.errors import WorkflowError
from pano_mvs.core.yaml_text import parse_yaml
from pano_mvs.engine.workflows.merged_stages import GROUP_KEYS
from pano_mvs.engine.workflows.policy import RESERVED_KEYS

WIDTH = 120
_TOP = ("pano_mvs", "name", "description", "extends", "plugins", "stages")
_MOST_PADDED = 8  # names up to this length, and up to the median one, have their values in one column
_NOT_PLAIN = re.compile(r"[,\[\]{}#&*!|>'\"%@`]|^[-?:]|: |:$|^\s|\s$|^$|[\x00-\x1f\x7f-\x9f\u2028\u2029]")
_SHARED = re.compile(r"(^|[\s\[{,])[&*!][\w<]")  # an anchor, an alias or a tag


@dataclass
class _Entry:
    """A key of a mapping with its value, and the comments that belong to it."""

    key: str
    node: Node
    lines: list[str]  # as written, without the comments before it
    before: list[str] = field(default_factory=list)  # comment and empty lines before it, without indentation
    behind: str = ""  # the comment behind its last line


def formatted(text: str, shown_as: str) -> str:
    """Return a workflow file in the usual layout; it means the same.

    Args:
        text: YAML 1.2.
        shown_as: name of the file in messages.

    Raises:
        WorkflowError: if it is not a mapping in YAML.
    """
    value = parse_yaml(text, shown_as)
    root = YAML(typ="rt", pure=True).compose(text)
    if not isinstance(value.value, dict) or not isinstance(root, MappingNode):
        raise WorkflowError([f"{shown_as}: a workflow is a mapping with the key stages"])
    lines = text.splitlines()
    if root.flow_style or root.start_mark.column or any(line.startswith(("---", "...", "%")) for line in lines):
        return text  # one flow mapping, as a program writes it, an indented one, or one with marks of documents
    entries, rest = _entries(root, lines, end=len(lines))
    entries.sort(key=lambda entry: _TOP.index(entry.key) if entry.key in _TOP else len(_TOP))
    found: list[str] = []
    for entry in entries:
        found += entry.before
        found += _stages(entry, lines) if entry.key == "stages" else _top(entry)
    made = "\n".join([*found, *rest]).rstrip("\n") + "\n"
    if parse_yaml(made, shown_as).plain() != value.plain() or Counter(_comments(made)) != Counter(_comments(text)):
        raise WorkflowError([f"{shown_as}: cannot be laid out without losing something; it was left as it is"])
    return made


def _entries(node: MappingNode, lines: list[str], *, end: int) -> tuple[list[_Entry], list[str]]:
    """Return the entries of a mapping in block style, and the comments behind the last one.

    Args:
        end: the line behind the mapping.
    """
    keys = [(str(key.value), key.start_mark.line, value) for key, value in node.value]
    found: list[_Entry] = []
    before = [line.strip() for line in lines[: keys[0][1]] if line.strip().startswith("#")] if _is_root(node) else []
    for (key, start, value), following in zip(keys, [*(line for _, line, _ in keys[1:]), end], strict=True):
        own = lines[start:following]
        after: list[str] = []
        column = int(node.value[0][0].start_mark.column)
        while own and (not own[-1].strip() or (own[-1].lstrip().startswith("#") and _indentation(own[-1]) <= column)):
            after.insert(0, own.pop().strip())
        found.append(_Entry(key, value, own, before=before, behind=_comment_behind(own[-1]) if own else ""))
        before = after
    return found, before


def _indentation(line: str) -> int:
    return len(line) - len(line.lstrip())


def _is_root(node: MappingNode) -> bool:
    return int(node.start_mark.column) == 0


def _top(entry: _Entry) -> Iterator[str]:
    """Yield the lines of a key of the file other than `stages`."""
    line = f"{entry.key}: {_block(entry.node)}" + (f"  {entry.behind}" if entry.behind else "")
    if _is_plain(entry) and len(line) <= WIDTH and not isinstance(entry.node, MappingNode):
        yield line
    else:
        yield from _written(entry, indent="")


def _stages(entry: _Entry, lines: list[str], indent: str = "") -> Iterator[str]:
    """Yield the lines of the stages, of the file or of a group: one line each where it fits."""
    node = entry.node
    if not isinstance(node, MappingNode) or node.flow_style or not node.value:
        yield from _written(entry, indent=indent)
        return
    start = _line_of(entry, lines)
    first = node.value[0][0].start_mark.line
    head = [line.strip() for line in lines[start + 1 : first]]
    found, rest = _entries(node, lines, end=start + len(entry.lines))
    lengths = sorted(len(one.key) for one in found)
    most = max(_MOST_PADDED, lengths[len(lengths) // 2])
    padded = max((length for length in lengths if length <= most), default=0) + 2
    yield f"{indent}stages:" + (f"  {behind}" if (behind := _comment_behind(entry.lines[0])) else "")
    inner = f"{indent}  "
    for line in head:
        yield f"{inner}{line}".rstrip()
    for stage in found:
        for line in stage.before:
            yield f"{inner}{line}".rstrip()
        yield from (
            _group(stage, lines, padded=padded, indent=inner) if _is_long_group(stage) else _stage(stage, padded, inner)
        )
    for line in rest:
        yield f"{inner}{line}".rstrip()


def _is_long_group(entry: _Entry) -> bool:
    """Return whether an entry is a group in block style whose stages take lines of their own."""
    if not isinstance(entry.node, MappingNode) or entry.node.flow_style:
        return False
    keys = {str(key.value): value for key, value in entry.node.value}
    inner = keys.get("stages")
    if not keys.keys() <= {*GROUP_KEYS} or not isinstance(inner, MappingNode) or inner.flow_style:
        return False
    return not any(_SHARED.search(line) for line in entry.lines) and not any(map(_has_long_text, keys.values()))


def _group(entry: _Entry, lines: list[str], *, padded: int, indent: str) -> Iterator[str]:
    """Yield the lines of a group: one if it has a single stage and fits, else its stages as those of the file."""
    node = entry.node
    assert isinstance(node, MappingNode)
    single = next(value for key, value in node.value if key.value == "stages")
    if len(single.value) == 1 and _is_plain(entry):
        made = list(_stage(entry, padded, indent))
        if len(made) == 1:
            yield made[0]
            return
    start = _line_of(entry, lines)
    parts, rest = _entries(node, lines, end=start + len(entry.lines))
    parts[0].before = [line.strip() for line in lines[start + 1 : node.value[0][0].start_mark.line]]
    parts.sort(key=lambda part: GROUP_KEYS.index(part.key))
    comment = _comment_behind(entry.lines[0])
    yield f"{indent}{entry.key}:" + (f"  {comment}" if comment else "")
    inner = f"{indent}  "
    for part in parts:
        for line in part.before:
            yield f"{inner}{line}".rstrip()
        if part.key == "stages":
            yield from _stages(part, lines, inner)
        elif _is_plain(part):
            yield f"{inner}{part.key}: {_block(part.node)}" + (f"  {part.behind}" if part.behind else "")
        else:
            yield from _written(part, indent=inner)
    for line in rest:
        yield f"{inner}{line}".rstrip()


def _line_of(entry: _Entry, lines: list[str]) -> int:
    """Return the line of an entry's key."""
    return next(idx for idx, line in enumerate(lines) if line is entry.lines[0])


def _stage(entry: _Entry, padded: int, indent: str) -> Iterator[str]:
    if not isinstance(entry.node, MappingNode) or not _is_plain(entry):
        yield from _written(entry, indent=indent)
        return
    pairs = _sorted(entry.node)
    behind = f"  {entry.behind}" if entry.behind else ""
    text = ", ".join(f"{_scalar(key)}: {_value(key, value)}" for key, value in pairs)
    line = f"{indent}{f'{entry.key}:'.ljust(max(padded, len(entry.key) + 2))}{{{text}}}{behind}"
    if len(line) <= WIDTH:
        yield line
        return
    yield f"{indent}{entry.key}:{behind}"
    for key, value in pairs:
        yield f"{indent}  {_scalar(key)}: {_value(key, value)}"


def _sorted(node: MappingNode) -> list[tuple[str, Node]]:
    """Return the keys and values of a stage or a group: what it is first, then its settings, then the other keys."""
    pairs = [(str(key.value), value) for key, value in node.value]
    first, last = ("use", "group"), (*RESERVED_KEYS, "stages")
    return sorted(pairs, key=lambda pair: 0 if pair[0] in first else 2 if pair[0] in last else 1)


def _value(key: str, node: Node) -> str:
    """Return a value of a stage or a group on one line."""
    if key != "stages" or not isinstance(node, MappingNode):
        return _flow(node)
    inner = ((str(name.value), value) for name, value in node.value)
    return "{" + ", ".join(f"{_scalar(name)}: {_entry_text(value)}" for name, value in inner) + "}"


def _entry_text(node: Node) -> str:
    """Return a stage in a group on one line."""
    if not isinstance(node, MappingNode):
        return _flow(node)
    return "{" + ", ".join(f"{_scalar(key)}: {_flow(value)}" for key, value in _sorted(node)) + "}"


def _written(entry: _Entry, *, indent: str) -> Iterator[str]:
    """Yield the lines of an entry as they are, moved to an indentation."""
    old = _indentation(entry.lines[0])
    for line in entry.lines:
        yield f"{indent}{line[old:]}".rstrip() if not line[:old].strip() else line.rstrip()


def _is_plain(entry: _Entry) -> bool:
    """Return whether an entry can be written again: no comments inside, no anchors, aliases, tags or long texts."""
    inner = entry.lines[:-1] if entry.behind else entry.lines
    if any(_comment_behind(line) or line.lstrip().startswith("#") for line in inner):
        return False
    return not any(_SHARED.search(line) for line in entry.lines) and not _has_long_text(entry.node)


def _has_long_text(node: Node) -> bool:
    if isinstance(node, ScalarNode):
        return node.style in ("|", ">")
    parts = [part for pair in node.value for part in pair] if isinstance(node, MappingNode) else node.value
    return any(_has_long_text(part) for part in parts)


def _block(node: Node) -> str:
    """Return a value behind a key on a line of its own, where a text may contain commas and quotes."""
    text = str(node.value)
    is_text = isinstance(node, ScalarNode) and text[:1].isalpha() and not set(text) & set("#\n:") and text.isprintable()
    return text if is_text and text == text.strip() and _is_read_as(text, text) else _flow(node)


def _flow(node: Node) -> str:
    if isinstance(node, MappingNode):
        return "{" + ", ".join(f"{_scalar(str(key.value))}: {_flow(value)}" for key, value in node.value) + "}"
    if isinstance(node, SequenceNode):
        return "[" + ", ".join(map(_flow, node.value)) + "]"
    assert isinstance(node, ScalarNode)
    text = str(node.value)
    if node.style in ("'", '"'):
        return _scalar(text)
    if not text:
        return "null"
    return text if not set(text) & set(",[]{}") else _scalar(text)  # a plain text with one of these is a string


def _scalar(text: str) -> str:
    """Return a text as YAML, without quotes if it needs none."""
    plain = not _NOT_PLAIN.search(text) and _is_read_as(f"[{text}]", [text])
    return text if plain else json.dumps(text, ensure_ascii=False)


def _is_read_as(text: str, value: object) -> bool:
    """Return whether a YAML text means a value; one that is refused, such as an infinite number, does not."""
    try:
        return bool(parse_yaml(text, "").plain() == value)
    except WorkflowError:
        return False


def _comment_behind(line: str) -> str:
    """Return the comment at the end of a line that begins outside of quotes; "" if there is none."""
    found = _comments(line)
    return found[-1] if found else ""


def _comments(text: str) -> list[str]:
    """Return the comments of a YAML text, each from its `#` to the end of its line.

    A `#` begins a comment at the beginning of a line or behind a blank, outside of quotes. A quote opens a quoted text
    only where a value may begin.
    """
    found: list[str] = []
    place, quote = 0, ""
    while place < len(text):
        sign = text[place]
        if quote == '"' and sign == "\\":
            place += 2
            continue
        if quote == "'" and text[place : place + 2] == "''":
            place += 2
            continue
        if quote:
            quote = "" if sign == quote else quote
        elif sign in "'\"" and _begins_value(text[:place]):
            quote = sign
        elif sign == "#" and (not place or text[place - 1] in " \t\n"):
            end = text.find("\n", place)
            end = len(text) if end < 0 else end
            found.append(text[place:end].rstrip())
            place = end
        place += 1
    return found


def _begins_value(before: str) -> bool:
    """Return whether a value may begin behind a text: at the beginning of a line, or behind one of `[{,:-?`."""
    line = before.rpartition("\n")[2].rstrip(" \t")
    return not line or line[-1] in "[{,:-?"
