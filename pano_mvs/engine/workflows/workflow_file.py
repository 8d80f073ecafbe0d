"""Read a workflow file with its top-level keys, the files that it extends, and the files of its groups of stages."""

from __future__ import annotations

import stat
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pano_mvs.core.errors import InputError, WorkflowError
from pano_mvs.core.file_names import is_plain_name
from pano_mvs.core.paths import children, exists, is_file, resolved
from pano_mvs.core.yaml_text import Located, Problems, did_you_mean, parse_yaml

FORMAT_VERSION = 1
MAX_BYTES = 100_000
MAX_FILES = 50
GROUPS_FOLDER = "groups"  # of the presets: the groups of stages that can be named
TOP_KEYS = ("pano_mvs", "name", "description", "extends", "plugins", "stages")


@dataclass(frozen=True, slots=True)
class WorkflowFile:
    """The content of one workflow file."""

    shown_as: str  # its name in messages
    base: Path  # folder that its relative paths start from
    text: str
    root: Located
    chain: tuple[Path, ...] = ()  # the files that led to it, each by the one before; it is last
    inherits: frozenset[str] = frozenset()  # `shown_as` of the files that it extends, and that these extend

    @property
    def stages(self) -> Mapping[str, Located]:
        """Its entries under `stages:`, by name: stages and groups of stages."""
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
class WorkflowFilesReader:
    """Reads a workflow file and all files that it extends, each once, the extended ones first.

    Files of groups are read on request, with all files that they extend.
    """

    problems: Problems
    presets: Path | None = None  # folder of the workflows and groups that can be named, or None
    on_file: Callable[[Path], None] = lambda _: None  # called with each file before it is read, also a missing one
    files: list[WorkflowFile] = field(default_factory=list)
    _seen: dict[Path, str] = field(default_factory=dict)  # extended file to its name in messages
    _count: list[int] = field(default_factory=lambda: [0])  # number of files so far, in one place for all readers

    def read(self, text: str, shown_as: str, base: Path, *, chain: tuple[Path, ...] = ()) -> None:
        """Read a workflow and, before it, the files that it extends.

        Args:
            chain: the files that lead to this one, each by the one before; empty if the text is not a file.
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
        names: list[str] = []
        for item in self._extended(root):
            path = self._find(item, base)
            if path is not None and (name := self._follow(item, path, chain)):
                names.append(name)
        inherited = (file.inherits for file in self.files if file.shown_as in names)
        inherits = frozenset(names).union(*inherited)
        self.files.append(WorkflowFile(shown_as, base, text, root, chain, inherits))

    def read_group(self, item: Located, file: WorkflowFile) -> list[WorkflowFile]:
        """Return the file of a group, last, after the files that it extends; empty with problems if it is unusable.

        Args:
            item: the value of `group`: a file, or the name of a shipped group.
            file: the file that contains it.
        """
        path = self._find_group(item, resolved(Path()) if item.origin else file.base)
        reader = WorkflowFilesReader(self.problems, self.presets, self.on_file, _count=self._count)
        if path is not None:
            reader._follow(item, path, file.chain, key="group")
        return reader.files

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
        for folder in self._folders():
            if is_plain_name(name) and is_file(preset := folder / f"{name}.yaml"):
                return preset
        self.on_file(path)
        names = [file.stem for folder in self._folders() for file in children(folder, "*.yaml")]
        names += [file.name for file in children(base, "*.yaml")]
        hint = did_you_mean(name, sorted(names))
        self.problems.add(item.place, f"extends: there is no file {str(path)[:200]} and no preset {name[:80]!r}.{hint}")
        return None

    def _find_group(self, item: Located, base: Path) -> Path | None:
        name = item.value
        if not isinstance(name, str) or not name:
            self.problems.add(item.place, "group: must be a file with the stages of the group, or a shipped group")
            return None
        path, folder = base / name, self._folders()[-1:]
        shipped = [folder[0] / f"{name}.yaml"] if folder and is_plain_name(name) else []
        for found in (path, *shipped):  # a folder beside the workflow may have the name of a shipped group
            if is_file(found):
                return found
        self.on_file(path)
        names = [file.stem for one in folder for file in children(one, "*.yaml")]
        hint = did_you_mean(name, sorted([*names, *(file.name for file in children(base, "*.yaml"))]))
        why = f"there is no file {str(path)[:200]} and no shipped group {name[:80]!r}.{hint}"
        self.problems.add(item.place, f"group: {why}")
        return None

    def _folders(self) -> list[Path]:
        """Return the folders of the workflows and of the groups that can be named."""
        return [self.presets, self.presets / GROUPS_FOLDER] if self.presets else []

    def _follow(self, item: Located, path: Path, chain: tuple[Path, ...], *, key: str = "extends") -> str:
        """Read a file that another one names, and return its name in messages; empty if it cannot be read."""
        real = resolved(path)
        if real in chain:
            circle = " → ".join(file.name for file in (*chain[chain.index(real) :], real))
            what = "the group contains itself" if key == "group" else "the files extend each other in a circle"
            self.problems.add(item.place, f"{key}: {what}: {circle}")
            return ""
        if real in self._seen:
            return self._seen[real]
        self._seen[real] = str(path)
        self._count[0] += 1
        if self._count[0] > MAX_FILES:
            raise WorkflowError([*self.problems.lines, f"{item.place}: {key}: at most {MAX_FILES} files are allowed"])
        self.on_file(path)
        try:
            self.read(read_text(path), str(path), path.parent, chain=(*chain, real))
        except InputError as error:
            self.problems.add(item.place, f"{key}: {error}")
            return ""
        except WorkflowError as error:  # the file is not YAML, or too large; this one may have further mistakes
            known = len(self.problems.lines)
            self.problems.lines += error.problems[known if error.problems[:known] == self.problems.lines else 0 :]
            return ""
        return str(path)

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
            is_newer = isinstance(version.value, int) and version.value > FORMAT_VERSION
            remedy = ". A newer pano_mvs reads it: upgrade" if is_newer else ""
            self.problems.add(
                version.place, f"workflow format {shown} is not supported; this version reads {FORMAT_VERSION}{remedy}"
            )
        if "name" in root.value and not is_plain_name(root.value["name"].plain()):
            self.problems.add(
                root.value["name"].place,
                "name must consist of letters, digits, '-', '_' and '.', and be a valid folder name",
            )
        description = root.value.get("description")
        if description is not None and not isinstance(description.value, str):
            self.problems.add(description.place, "description must be text")
        node = root.value.get("stages")
        missing = node is None and "extends" in root.value
        if not missing and (node is None or not isinstance(node.value, dict) or not node.value):
            self.problems.add((node or root).place, "`stages:` must be a mapping of stage names to {use: …}")
