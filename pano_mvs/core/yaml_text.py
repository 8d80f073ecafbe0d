"""Read YAML 1.2 into plain values with the file, line and column at which they are written."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import lru_cache
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from pano_mvs.core.errors import WorkflowError
from pano_mvs.core.file_names import is_printable

MAX_DEPTH = 40
MAX_VALUES = 100_000
MAX_PROBLEMS = 100
_SHOWN_CHARACTERS = 40
_CORE = "tag:yaml.org,2002:"
_KEY_TAGS = {f"{_CORE}{name}" for name in ("str", "null", "bool", "int", "float", "merge", "value")}


@dataclass(frozen=True, slots=True)
class Located:
    """A YAML value and its location."""

    value: Any  # a scalar, a dict of str to Located, or a list of Located
    line: int  # 1-based line of the value
    column: int  # 1-based column of the value
    key_line: int = 0  # 1-based line of its key, if it is an entry of a mapping
    key_column: int = 0  # likewise
    origin: str = ""  # shown instead of the location, for values from the command line
    file: str = ""  # name of the text in messages

    @property
    def place(self) -> str:
        """Location of the value: `file:line:column`, or its origin."""
        return self.origin or f"{self.file}:{self.line}:{self.column}"

    @property
    def key_place(self) -> str:
        """Location of its key, or of the value if it has no key."""
        return f"{self.file}:{self.key_line}:{self.key_column}" if self.key_line else self.place

    def plain(self) -> Any:
        """Return the value without locations."""
        if isinstance(self.value, dict):
            return {key: item.plain() for key, item in self.value.items()}
        if isinstance(self.value, list):
            return [item.plain() for item in self.value]
        return self.value

    def at(self, path: tuple[Any, ...]) -> Located:
        """Return the value at a path of keys and positions, or the nearest one above it."""
        here = self
        for step in path:
            try:
                inner = here.value[step]
            except (KeyError, IndexError, TypeError):
                break
            here = inner if isinstance(inner, Located) else here
        return here


class Problems:
    """The errors found so far, one line each; too many end the search."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def add(self, place: str, message: str) -> None:
        """Add an error.

        Raises:
            WorkflowError: with all errors, if the maximum is reached.
        """
        self.lines.append(f"{place}: {message}")
        if len(self.lines) >= MAX_PROBLEMS:
            raise WorkflowError([*self.lines, f"these are the first {MAX_PROBLEMS} errors; fix them, then check again"])

    def raise_if_any(self) -> None:
        """Raise WorkflowError if there are errors."""
        if self.lines:
            raise WorkflowError(self.lines)


def parse_yaml(text: str, name: str, problems: Problems | None = None) -> Located:
    """Return the document in a YAML 1.2 text.

    Args:
        name: name of the text in messages, such as its path.
        problems: receives errors that leave the rest readable, such as a key that occurs twice; None raises them.

    Raises:
        WorkflowError: with every error found, as `name:line:column: message`.
    """
    try:
        root = _composed(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{name}:{mark.line + 1}:{mark.column + 1}" if mark else name
        raise WorkflowError([f"{place}: {_shortened(error.problem or error.context or 'not valid YAML')}"]) from None
    except YAMLError as error:
        raise WorkflowError([f"{name}: {_unreadable(text) or 'not valid YAML: ' + _shortened(str(error))}"]) from None
    except (ValueError, IndexError, AssertionError, KeyError, TypeError, AttributeError) as error:
        # Bugs of ruamel.yaml with malformed directives, tags and escapes.
        raise WorkflowError([f"{name}: not valid YAML ({type(error).__name__}: {_shortened(str(error))})"]) from None
    if root is None:
        raise WorkflowError([f"{name}:1:1: the file is empty"])
    builder = _Builder(name, Problems() if problems is None else problems)
    located = builder.build(root, 0)
    if problems is None:
        builder.problems.raise_if_any()
    return located


def report_invalid(
    error: ValidationError,
    node: Located,
    problems: Problems,
    *,
    model: type[BaseModel],
    also: Sequence[str] = (),
    subject: str = "",
) -> None:
    """Add a line for each setting that does not fit a model.

    Args:
        also: further keys that are allowed beside the fields of the model.
        subject: what the settings belong to, at the beginning of each line.
    """
    for problem in error.errors(include_url=False):
        path = tuple(problem["loc"])
        found = node.at(path)
        key = ".".join(map(str, path))
        if problem["type"] == "extra_forbidden":
            hint = did_you_mean(str(path[-1]), [*_keys_at(model, path[:-1]), *(also if len(path) == 1 else ())])
            problems.add(found.key_place, f"{subject}unknown setting {key[:80]!r}.{hint}")
        elif problem["type"] == "missing":
            problems.add(found.key_place, f"{subject}setting {key!r} is missing")
        else:
            message = problem["msg"].removeprefix("Value error, ")
            if problem["type"] == "model_type":  # pydantic's message names the class
                message = "must be a mapping of settings"
            elif problem["type"] == "path_type" and isinstance(problem["input"], int | float):
                message = "YAML reads this as a number or truth value; put the name of a file in quotes"
            shown = json.dumps(problem["input"], default=str, ensure_ascii=False)[:80]
            setting = f"{key}: " if key else ""
            problems.add(found.place, f"{subject}{setting}{message} (got {shown})")


def _keys_at(model: type[BaseModel], path: tuple[Any, ...]) -> list[str]:
    """Return the keys of the settings at a path below a model; other steps are keys of mappings."""
    for step in path:
        fields = {info.alias or name: info for name, info in model.model_fields.items()}
        if step in fields:
            model = next(_models_in(fields[step].annotation), model)
    return [info.alias or name for name, info in model.model_fields.items()]


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models_in(inner)


def did_you_mean(word: str, options: Sequence[str] | Mapping[str, object]) -> str:
    """Return a hint for an unknown word: similar options, or else all of them."""
    close = get_close_matches(word[:80], list(options), n=2, cutoff=0.6)
    if close:
        return f" Did you mean {' or '.join(map(repr, close))}?"
    shown = list(options)[:40]
    return f" Known: {', '.join(shown)}{', …' if len(options) > len(shown) else ''}" if shown else ""


@lru_cache(maxsize=64)  # a command reads the same workflow more than once, and many of them extend the same one
def _composed(text: str) -> Node | None:
    yaml = YAML(typ="safe", pure=True)
    yaml.Composer = _Composer
    root: Node | None = yaml.compose(text)
    return root


class _Composer(Composer):
    """ruamel's composer, which is recursive, with a maximum depth."""

    def __init__(self, loader: Any = None) -> None:
        super().__init__(loader)
        self.warn_double_anchors = False
        self._level = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Return the next node."""
        self._level += 1
        if self._level > MAX_DEPTH + 1:
            mark = self.parser.peek_event().start_mark
            raise MarkedYAMLError(
                problem=f"nested too deeply; at most {MAX_DEPTH} levels are allowed", problem_mark=mark
            )
        node = super().compose_node(parent, index)
        self._level -= 1
        return node


def _shortened(text: str) -> str:
    line = text.strip().split("\n")[0]
    return line if len(line) <= 5 * _SHOWN_CHARACTERS else f"{line[: 5 * _SHOWN_CHARACTERS]}…"


def _unreadable(text: str) -> str:
    """Return a message with the location of the first character that YAML does not allow."""
    for number, line in enumerate(text.split("\n"), 1):
        for column, sign in enumerate(line.removesuffix("\r"), 1):
            if sign != "\t" and not is_printable(sign):
                return f"line {number}, column {column}: the control character {sign!r} is not allowed; remove it"
    return ""


class _Builder:
    """Turns ruamel's nodes into located values, and collects errors."""

    def __init__(self, name: str, problems: Problems) -> None:
        self.name = name
        self.problems = problems
        self.count = 0

    def build(self, node: Node, depth: int) -> Located:
        line, column = node.start_mark.line + 1, node.start_mark.column + 1
        self.count += 1
        if depth > MAX_DEPTH or self.count > MAX_VALUES:
            limit = f"{MAX_DEPTH} levels" if depth > MAX_DEPTH else f"{MAX_VALUES} values"
            raise WorkflowError(
                [*self.problems.lines, f"{self.name}:{line}:{column}: too large; at most {limit} are allowed"]
            )
        value: Any
        if isinstance(node, MappingNode):
            self._require_tag(node, "map")
            value = self._mapping(node, depth)
        elif isinstance(node, SequenceNode):
            self._require_tag(node, "seq")
            value = [self.build(item, depth + 1) for item in node.value]
        else:
            assert isinstance(node, ScalarNode)
            value = self._scalar(node)
        return Located(value, line, column, file=self.name)

    def _mapping(self, node: MappingNode, depth: int) -> dict[str, Located]:
        entries: dict[str, Located] = {}
        merged: list[Node] = []
        for key_node, value_node in node.value:
            line, column = key_node.start_mark.line + 1, key_node.start_mark.column + 1
            if not isinstance(key_node, ScalarNode):
                self._problem(key_node, "a key must be a plain scalar")
                continue
            key = str(key_node.value)
            if str(key_node.tag) not in _KEY_TAGS:
                self._problem(key_node, f"tag {_shown(key_node.tag)} is not allowed; write a plain key")
            elif not is_printable(key):
                self._problem(key_node, f"key {key[:_SHOWN_CHARACTERS]!r} contains control characters")
            elif str(key_node.tag) == f"{_CORE}merge":
                merged.append(value_node)
            elif key in entries:
                self._problem(
                    key_node, f"key {key[:_SHOWN_CHARACTERS]!r} occurs twice (first in line {entries[key].key_line})"
                )
            else:
                value = self.build(value_node, depth + 1)
                entries[key] = Located(value.value, value.line, value.column, line, column, file=self.name)
        for value_node in merged:
            parts = value_node.value if isinstance(value_node, SequenceNode) else [value_node]
            for part in parts:
                if isinstance(part, MappingNode):
                    entries = self.build(part, depth + 1).value | entries
                else:
                    self._problem(part, "a merge key (<<) takes a mapping or a list of mappings")
        return entries

    def _require_tag(self, node: Node, tag: str) -> None:
        if str(node.tag) != f"{_CORE}{tag}":
            self._problem(node, f"tag {_shown(node.tag)} is not allowed; write a plain value")

    def _scalar(self, node: ScalarNode) -> Any:
        text = str(node.value)
        tag = str(node.tag).removeprefix(_CORE)
        match tag:
            case "str":
                if not is_printable(text.replace("\n", "").replace("\t", "")):
                    self._problem(node, f"{text[:_SHOWN_CHARACTERS]!r} contains control characters; remove them")
                return text
            case "null":
                return None
            case "bool" if text.lower() in {"true", "false"}:
                return text.lower() == "true"
            case "int" | "float":
                return self._number(node, text, tag)
        self._problem(node, f"tag {_shown(node.tag)} is not allowed; write a plain value")
        return None

    def _number(self, node: ScalarNode, text: str, tag: str) -> int | float | None:
        digits = text.replace("_", "") if len(text) <= 400 else ""
        try:
            if tag == "int":
                return int(digits, 0) if digits[:2] in ("0x", "0o") else int(digits)
            value = float(digits.replace(".inf", "inf").replace(".nan", "nan").replace(".Inf", "inf"))
        except ValueError:
            self._problem(node, f"{text[:_SHOWN_CHARACTERS]!r} is not a usable number")
            return None
        if not math.isfinite(value):
            self._problem(node, f"{text[:_SHOWN_CHARACTERS]!r} is not a finite number")
            return None
        return value

    def _problem(self, node: Node, message: str) -> None:
        self.problems.add(f"{self.name}:{node.start_mark.line + 1}:{node.start_mark.column + 1}", message)


def _shown(tag: object) -> str:
    return repr(str(tag) if len(str(tag)) <= 2 * _SHOWN_CHARACTERS else f"{str(tag)[: 2 * _SHOWN_CHARACTERS]}…")
