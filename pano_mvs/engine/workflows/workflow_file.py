"""Read a workflow file with its top-level keys, and the files that it extends; merge their stages."""

from __future__ import annotations

import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pano_mvs.core.errors import InputError, WorkflowError
from pano_mvs.core.file_names import is_plain_name
from pano_mvs.core.paths import children, exists, is_file, resolved
from pano_mvs.core.yaml_text import Located, Problems, did_you_mean, parse_yaml

FORMAT_VERSION = 1
MAX_BYTES = 100_000
MAX_FILES = 50
MAX_STAGES = 1000
TOP_KEYS = ("pano_mvs", "name", "description", "extends", "plugins", "stages")


@dataclass(frozen=True, slots=True)
class WorkflowFile:
    """The content of one workflow file."""

    shown_as: str  # its name in messages
    base: Path  # folder that its relative paths start from
    text: str
    root: Located

    @property
    def stages(self) -> Mapping[str, Located]:
        """Its entries under `stages:`, by name."""
        node = self.root.value.get("stages")
        return node.value if node is not None and isinstance(node.value, dict) else {}


def read_text(path: Path, what: str = "workflow") -> str:
    """Return the text of a YAML file.

    Args:
        what: its purpose, for messages.

    Raises:
        InputError: if it is not a regular file, too large, or not text.
    """
    try:
        info = path.stat()
        if stat.S_ISDIR(info.st_mode):
            raise InputError(f"{what} {path} is a folder: give the path of a YAML file")
        if not stat.S_ISREG(info.st_mode):
            raise InputError(
                f"{what} {path} is not a regular file (a pipe, a socket or a device): give the path of a YAML file"
            )
        if info.st_size > MAX_BYTES:
            raise InputError(
                f"{what} {path} has {info.st_size} bytes, but at most {MAX_BYTES} are allowed: is it a {what}?"
            )
        with path.open("rb") as stream:
            return stream.read(MAX_BYTES + 1).decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{what} {path} cannot be read: byte {error.start} is not UTF-8. Save it as UTF-8 text, or "
            "give another file"
        ) from error
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{what} {path} cannot be read: {error}. Check its permissions, or give another file"
        ) from error


@dataclass(slots=True)
class ExtendsReader:
    """Reads a workflow file and all files that it extends, each once, the extended ones first."""

    problems: Problems
    presets: Path | None = None  # folder of the workflows that can be extended by name, or None
    files: list[WorkflowFile] = field(default_factory=list)
    _seen: set[Path] = field(default_factory=set)

    def read(self, text: str, shown_as: str, base: Path, *, chain: tuple[Path, ...] = ()) -> None:
        """Read a workflow and, before it, the files that it extends.

        Args:
            chain: the files that extend each other up to this one, which is last; empty if the text is not a file.
        """
        root = parse_yaml(text, shown_as, self.problems)
        if not isinstance(root.value, dict):
            raise WorkflowError(
                [
                    *self.problems.lines,
                    f"{root.place}: a workflow must be a mapping with the keys {', '.join(TOP_KEYS)}",
                ]
            )
        self._check_top(root)
        for item in self._extended(root):
            path = self._find(item, base)
            if path is not None:
                self._follow(item, path, chain)
        self.files.append(WorkflowFile(shown_as, base, text, root))

    def _extended(self, root: Located) -> Iterator[Located]:
        node = root.value.get("extends")
        if node is None or node.value is None:
            return
        for item in node.value if isinstance(node.value, list) else [node]:
            if isinstance(item.value, str) and item.value:
                yield item
            else:
                self.problems.add(item.place, "extends: must be a workflow file or a preset, or a list of them")

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
            raise WorkflowError([*self.problems.lines, f"{item.place}: extends: at most {MAX_FILES} files are allowed"])
        try:
            self.read(read_text(path), str(path), path.parent, chain=(*chain, real))
        except InputError as error:
            self.problems.add(item.place, f"extends: {error}")
        except WorkflowError as error:  # the file is not YAML, or too large; this one may have further mistakes
            known = len(self.problems.lines)
            self.problems.lines += error.problems[known if error.problems[:known] == self.problems.lines else 0 :]

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
                version.place, f"workflow format {shown} is not supported; this version reads {FORMAT_VERSION}"
            )
        if "name" in root.value and not is_plain_name(root.value["name"].plain()):
            self.problems.add(
                root.value["name"].place,
                "name must consist of letters, digits, '-', '_' and '.', and be a valid folder name",
            )
        node = root.value.get("stages")
        missing = node is None and "extends" in root.value
        if not missing and (node is None or not isinstance(node.value, dict) or not node.value):
            self.problems.add((node or root).place, "`stages:` must be a mapping of stage names to {use: …}")


def merge_stages(files: Sequence[WorkflowFile], problems: Problems) -> dict[str, Located]:
    """Merge the stages of several files; later files override earlier ones.

    An entry for an existing stage keeps the position of the stage and overrides single settings. With another `use` it
    replaces the stage, and `null` removes it. A new stage is inserted behind the stage that precedes it in its file,
    else before the one that follows it, else at the end.
    """
    stages: dict[str, Located] = {}
    for file in files:
        order = list(stages)
        written = list(file.stages)
        for idx, name in enumerate(written):
            if name not in stages:
                order.insert(_position(order, written, idx), name)
        for name, node in file.stages.items():
            _merge_entry(stages, name, node, problems=problems)
        stages = {name: stages[name] for name in order if name in stages}
        if len(stages) > MAX_STAGES:
            raise WorkflowError([*problems.lines, f"{file.root.place}: at most {MAX_STAGES} stages are allowed"])
    return stages


def _position(order: Sequence[str], written: Sequence[str], idx: int) -> int:
    if idx:
        return order.index(written[idx - 1]) + 1
    return next((order.index(name) for name in written[1:] if name in order), len(order))


def _merge_entry(stages: dict[str, Located], name: str, node: Located, *, problems: Problems) -> None:
    if not is_plain_name(name):
        problems.add(
            node.key_place,
            f"stage name {name[:80]!r} must consist of letters, digits, '-', '_' and '.', and be a valid folder name",
        )
    elif node.value is None and name in stages:
        del stages[name]
    elif node.value is None:
        hint = did_you_mean(name, stages) if stages else " Write `{use: NAME}`"
        problems.add(
            node.key_place, f"stage {name!r} needs `use: NAME`; there is no stage of that name to remove.{hint}"
        )
    elif not isinstance(node.value, dict):
        problems.add(node.key_place, f"stage {name!r} needs `use: NAME`: write `{name}: {{use: …}}`")
    elif "use" not in node.value and name not in stages:
        hint = f"; no file that is extended has a stage of that name.{did_you_mean(name, stages)}" if stages else ""
        problems.add(node.key_place, f"stage {name!r} needs `use: NAME`{hint}")
    else:
        stages[name] = merged_entry(stages.get(name), node)


def merged_entry(below: Located | None, above: Located) -> Located:
    """Return a stage's entry with overrides from a later file; another `use` replaces the entry."""
    mine = above.value.get("use")
    if below is None or (mine is not None and mine.value != below.value["use"].value):
        return above
    value = {**below.value, **above.value}
    return Located(value, above.line, above.column, above.key_line, above.key_column, above.origin, above.file)
