"""A workflow's files: the one that is given and those that it extends, read and laid over each other."""

from __future__ import annotations

import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path

from pano_mvs.core.errors import InputError, WorkflowError
from pano_mvs.core.file_names import is_plain_name
from pano_mvs.core.paths import children, exists, is_file, resolved
from pano_mvs.engine.workflows.yaml_text import Located, Problems, parse_yaml

FORMAT_VERSION = 1
MAX_BYTES = 100_000
MAX_FILES = 50
MAX_STAGES = 1000
TOP_KEYS = ("pano_mvs", "name", "description", "extends", "plugins", "stages")


@dataclass(frozen=True, slots=True)
class WorkflowFile:
    """One workflow file as it is written.

    Attributes:
        shown_as: what it is called in messages.
        base: the folder that its relative paths are relative to.
        text: the YAML.
        root: the mapping at its top.
    """

    shown_as: str
    base: Path
    text: str
    root: Located

    @property
    def stages(self) -> Mapping[str, Located]:
        """What it says of stages, by name."""
        node = self.root.value.get("stages")
        return node.value if node is not None and isinstance(node.value, dict) else {}


def read_text(path: Path) -> str:
    """Return the text of a workflow file.

    Raises:
        InputError: if it is no plain file, too large, or not text; with what to do.
    """
    try:
        info = path.stat()
        if stat.S_ISDIR(info.st_mode):
            raise InputError(f"workflow {path} is a folder: name the YAML file in it")
        if not stat.S_ISREG(info.st_mode):
            raise InputError(f"workflow {path} is no plain file (a pipe, a socket or a device): name a YAML file")
        if info.st_size > MAX_BYTES:
            raise InputError(f"workflow {path} has {info.st_size} bytes, {MAX_BYTES} are allowed: is it a workflow?")
        with path.open("rb") as stream:
            return stream.read(MAX_BYTES + 1).decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise InputError(
            f"workflow {path} cannot be read: byte {error.start} is not UTF-8. Save it as UTF-8 text, or "
            "name another file"
        ) from error
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"workflow {path} cannot be read: {error}. Mend it, or name another file") from error


@dataclass(slots=True)
class ExtendsReader:
    """Reads a file and all that it extends: each once, those that are extended first.

    Attributes:
        problems: where mistakes go.
        presets: folder of the workflows that may be extended by name, or None.
        layers: what was read.
    """

    problems: Problems
    presets: Path | None = None
    layers: list[WorkflowFile] = field(default_factory=list)
    _seen: set[Path] = field(default_factory=set)

    def read(self, text: str, shown_as: str, base: Path, *, chain: tuple[Path, ...] = ()) -> None:
        """Read a text and, before it, what it extends.

        Args:
            text: the YAML.
            shown_as: what to call it in messages.
            base: the folder that its relative paths are relative to.
            chain: the files that led here, this one last; empty for a text that is no file.
        """
        root = parse_yaml(text, shown_as)
        if not isinstance(root.value, dict):
            raise WorkflowError([f"{root.place}: a workflow is a mapping with the keys {', '.join(TOP_KEYS)}"])
        self._check_top(root)
        for item in self._extended(root):
            path = self._find(item, base)
            if path is not None:
                self._follow(item, path, chain)
        self.layers.append(WorkflowFile(shown_as, base, text, root))

    def _extended(self, root: Located) -> Iterator[Located]:
        node = root.value.get("extends")
        if node is None or node.value is None:
            return
        for item in node.value if isinstance(node.value, list) else [node]:
            if isinstance(item.value, str) and item.value:
                yield item
            else:
                self.problems.add(item.place, "extends: name a workflow file or a preset, or a list of them")

    def _find(self, item: Located, base: Path) -> Path | None:
        name = str(item.value)
        path = base / name
        if exists(path):
            return path
        preset = self.presets / f"{name}.yaml" if self.presets and is_plain_name(name) else None
        if preset is not None and is_file(preset):
            return preset
        names = [file.stem for file in children(self.presets, "*.yaml")] if self.presets else []
        names += [file.name for file in children(base, "*.yaml")]
        hint = did_you_mean(name, sorted(names))
        self.problems.add(item.place, f"extends: there is no file {str(path)[:200]} and no preset {name[:80]!r}.{hint}")
        return None

    def _follow(self, item: Located, path: Path, chain: tuple[Path, ...]) -> None:
        real = resolved(path)
        if real in chain:
            circle = " → ".join(file.name for file in (*chain[chain.index(real) :], real))
            self.problems.add(item.place, f"extends: the files extend each other in a circle: {circle}")
            return
        if real in self._seen:
            return
        self._seen.add(real)
        if len(self._seen) > MAX_FILES:
            raise WorkflowError([*self.problems.lines, f"{item.place}: extends: {MAX_FILES} files are allowed"])
        try:
            self.read(read_text(path), str(path), path.parent, chain=(*chain, real))
        except InputError as error:
            self.problems.add(item.place, f"extends: {error}")

    def _check_top(self, root: Located) -> None:
        for key, node in root.value.items():
            if key not in TOP_KEYS:
                self.problems.add(node.key_place, f"unknown key {key[:80]!r}.{did_you_mean(key, TOP_KEYS)}")
        version = root.value.get("pano_mvs")
        if version is None:
            self.problems.add(
                root.place, f"the key `pano_mvs: {FORMAT_VERSION}` is missing (the version of the workflow format)"
            )
        elif version.value != FORMAT_VERSION or isinstance(version.value, bool):
            shown = repr(version.plain())[:80]
            self.problems.add(
                version.place, f"workflow format {shown} is not known; this version reads {FORMAT_VERSION}"
            )
        if "name" in root.value and not is_plain_name(root.value["name"].plain()):
            self.problems.add(
                root.value["name"].place,
                "name must be a word of letters, digits, '-', '_' and '.' that may name a folder",
            )
        node = root.value.get("stages")
        missing = node is None and "extends" in root.value
        if not missing and (node is None or not isinstance(node.value, dict) or not node.value):
            self.problems.add((node or root).place, "`stages:` must be a mapping of stage names to {use: …}")


def merge_stages(layers: Sequence[WorkflowFile], problems: Problems) -> dict[str, Located]:
    """Lay the stages of files over each other; what comes later holds.

    A stage that is given again keeps its place and overrides setting by setting; with another `use` it is a new one;
    `null` removes it. A new one goes behind the stage that stands before it in its file, else before the one that
    stands behind it, else to the end.
    """
    stages: dict[str, Located] = {}
    for layer in layers:
        order = list(stages)
        written = list(layer.stages)
        for idx, name in enumerate(written):
            if name not in stages:
                order.insert(_position(order, written, idx), name)
        for name, node in layer.stages.items():
            _lay(stages, name, node, problems)
        stages = {name: stages[name] for name in order if name in stages}
        if len(stages) > MAX_STAGES:
            raise WorkflowError([*problems.lines, f"{layer.root.place}: {MAX_STAGES} stages are allowed"])
    return stages


def _position(order: Sequence[str], written: Sequence[str], idx: int) -> int:
    if idx:
        return order.index(written[idx - 1]) + 1
    return next((order.index(name) for name in written[1:] if name in order), len(order))


def _lay(stages: dict[str, Located], name: str, node: Located, problems: Problems) -> None:
    if not is_plain_name(name):
        problems.add(
            node.key_place,
            f"stage name {name[:80]!r} must be a word of letters, digits, '-' and '_' that may name a folder",
        )
    elif node.value is None and name in stages:
        del stages[name]
    elif node.value is None:
        hint = did_you_mean(name, stages) if stages else " Write `{use: NAME}`"
        problems.add(node.key_place, f"stage {name!r} needs `use: NAME`; there is none of that name to remove.{hint}")
    elif not isinstance(node.value, dict):
        problems.add(node.key_place, f"stage {name!r} needs `use: NAME`: write `{name}: {{use: …}}`")
    elif "use" not in node.value and name not in stages:
        hint = f"; no file that is extended has a stage of that name.{did_you_mean(name, stages)}" if stages else ""
        problems.add(node.key_place, f"stage {name!r} needs `use: NAME`{hint}")
    else:
        stages[name] = overlaid(stages.get(name), node)


def overlaid(below: Located | None, above: Located) -> Located:
    """Return a stage's entry with another laid over it; one with another `use` hides all that is below."""
    mine = above.value.get("use")
    if below is None or (mine is not None and mine.value != below.value["use"].value):
        return above
    value = {**below.value, **above.value}
    return Located(value, above.line, above.column, above.key_line, above.key_column, above.origin, above.file)


def did_you_mean(word: str, options: Sequence[str] | Mapping[str, object]) -> str:
    """Return a hint at what a word that is not known may have meant, or at what there is."""
    close = get_close_matches(word[:80], list(options), n=2, cutoff=0.6)
    if close:
        return f" Did you mean {' or '.join(map(repr, close))}?"
    shown = list(options)[:40]
    return f" Known: {', '.join(shown)}{', …' if len(options) > len(shown) else ''}" if shown else ""
