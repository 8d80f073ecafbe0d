"""Merge the stages of workflow files, one by one and in groups; later files override earlier ones.

An entry under `stages:` is a stage, or a group: a named list of stages, written in the file or in one of its own. All
stages of a workflow have different names, whatever their groups, so that a later file overrides each by its name.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, auto

from pano_mvs.core.errors import WorkflowError
from pano_mvs.core.file_names import is_plain_name
from pano_mvs.core.yaml_text import Located, Problems, did_you_mean
from pano_mvs.engine.workflows.workflow_file import WorkflowFile, WorkflowFilesReader

MAX_STAGES = 1000
GROUP_KEYS = ("group", "description", "stages")


@dataclass(frozen=True, slots=True)
class StageGroup:
    """A named list of stages of a workflow, which is replaced, extended and removed as one."""

    description: str
    stages: tuple[str, ...]  # in the order of the workflow


@dataclass(frozen=True, slots=True)
class Removed:
    """A stage that a later file or `--set` has removed, or a group."""

    how: str  # such as "was removed with the group 'masks' (--set masks)"
    use: object = None  # the registered stage; None for a group


class _Kind(Enum):
    STAGE = auto()  # an entry of a stage
    BESIDE = auto()  # a group is named here, as a place for what follows
    REMOVE = auto()  # a group is removed
    REPLACE = auto()  # the stages of a group are replaced by those that follow


@dataclass(frozen=True, slots=True)
class _Step:
    """One entry of a file, with those inside its groups in a row."""

    kind: _Kind
    name: str  # of the stage, or of the group
    node: Located
    group: str = ""  # the group that the entry is written in; empty if it is beside groups
    is_inside: bool = False  # whether a new stage takes its place from its neighbours in the group alone
    old: tuple[str, ...] = ()  # the stages that are removed


@dataclass(slots=True)
class _Group:
    description: str = ""
    files: set[str] = field(default_factory=set)  # `shown_as` of the workflow files that define it


@dataclass(slots=True)
class MergedStages:
    """The stages of the files that were added so far, in order, and their groups.

    An entry for an existing stage keeps the position of the stage and overrides single settings. With another `use` it
    replaces the stage, and `null` removes it. A new stage is inserted behind the stage that precedes it in its file,
    else before the one that follows it, else at the end. It joins the group of this neighbour.

    A group that a file inherits is replaced if the file gives it another `group`. Otherwise its entry is merged stage
    by stage, so that two workflows in one list of `extends` are merged as if they had no groups.
    """

    reader: WorkflowFilesReader
    problems: Problems
    stages: dict[str, Located] = field(default_factory=dict)
    group_of: dict[str, str] = field(default_factory=dict)  # stage to its group; stages beside groups are missing
    group_files: list[WorkflowFile] = field(default_factory=list)  # those that were read for groups
    written: set[str] = field(default_factory=set)  # names of all stages that an entry describes, also a wrong one
    notes: list[str] = field(default_factory=list)  # what the user should know, such as a group without a name
    removed: dict[str, Removed] = field(default_factory=dict)  # by name, also stages that a later entry has added again
    _groups: dict[str, _Group] = field(default_factory=dict)
    _first_file: dict[str, str] = field(default_factory=dict)  # stage to `shown_as` of the file that brought it

    def add(self, file: WorkflowFile) -> None:
        """Apply the entries of a file to the stages so far."""
        self.apply(file, file.stages)

    def apply(self, file: WorkflowFile, entries: Mapping[str, Located]) -> None:
        """Apply entries to the stages so far.

        Args:
            file: the file that contains them.
        """
        steps = self._steps(file, entries)
        order = self._order(steps)
        for step in steps:
            self._apply(step, file)
        self.stages = {name: self.stages[name] for name in order if name in self.stages}
        self.group_of = {name: group for name, group in self.group_of.items() if name in self.stages}
        used = {*self.group_of.values()}
        self._groups = {name: group for name, group in self._groups.items() if name in used}
        if len(self.stages) > MAX_STAGES:
            raise WorkflowError([*self.problems.lines, f"{file.root.place}: at most {MAX_STAGES} stages are allowed"])

    def groups(self, stages: Sequence[str]) -> dict[str, StageGroup]:
        """Return the groups of some stages, by name and in the order of their first stages."""
        found: dict[str, list[str]] = {}
        for stage in stages:
            if group := self.group_of.get(stage):
                found.setdefault(group, []).append(stage)
        return {name: StageGroup(self._groups[name].description, tuple(inner)) for name, inner in found.items()}

    def _steps(self, file: WorkflowFile, entries: Mapping[str, Located]) -> list[_Step]:
        """Return the entries of a file in a row, with the stages of its groups; those with mistakes are left out."""
        steps: list[_Step] = []
        for name, node in entries.items():
            is_known = name in self._groups and name not in self.stages
            if is_known and not node.value and (node.value is None or isinstance(node.value, dict)):
                kind = _Kind.REMOVE if node.value is None else _Kind.BESIDE
                old = self._members(list(self.stages), name) if kind is _Kind.REMOVE else ()
                steps.append(_Step(kind, name, node, old=old))
            elif is_group(node) and name not in {*self.stages, *(step.name for step in steps)}:
                steps += self._group_steps(file, name, node)
            elif is_known and not (isinstance(node.value, dict) and "use" in node.value):
                members = [stage for stage, group in self.group_of.items() if group == name]
                self.problems.add(
                    node.key_place,
                    f"{name!r} is a group of stages: write `{name}: {{stages: {{STAGE: …}}}}`, or the entry of one of "
                    f"its stages: {', '.join(members)}",
                )
            else:
                steps.append(_Step(_Kind.STAGE, name, node))
        return steps

    def _group_steps(self, file: WorkflowFile, name: str, node: Located) -> Iterator[_Step]:
        """Yield the steps of an entry that is a group."""
        if not self._is_valid(name, node):
            return
        given, before = node.value, len(self.problems.lines)
        is_inherited = name in self._groups and bool(self._groups[name].files & file.inherits)
        description = ""
        if "group" in given:
            inner, description = self._read(file, name, node)
        else:
            inner = given["stages"].value or {}
        if not inner and ("group" in given or name not in self._groups):
            if "group" not in given or len(self.problems.lines) == before:
                self.problems.add(node.key_place, f"group {name!r} has no stages")
            return
        if "group" in given and is_inherited:
            yield _Step(_Kind.REPLACE, name, _mapping_like(node, inner), old=self._members(list(self.stages), name))
        group = self._groups.setdefault(name, _Group())
        group.files.add(file.shown_as)
        if "description" in given or description:
            group.description = str(given["description"].value) if "description" in given else description
        is_inside = is_inherited and "group" not in given
        for stage, entry in inner.items():
            if not self._is_nested(entry, stage, group=name, known=self.stages):
                yield _Step(_Kind.STAGE, stage, entry, name, is_inside)
        if is_inherited:
            yield _Step(_Kind.BESIDE, name, node)

    def _is_valid(self, name: str, node: Located) -> bool:
        """Return whether the name and the keys of a group can be used, and report what cannot."""
        before = len(self.problems.lines)
        if not is_plain_name(name):
            self.problems.add(
                node.key_place,
                f"group name {name[:80]!r} must consist of letters, digits, '-', '_' and '.', and be a valid file name",
            )
        for key, value in node.value.items():
            if key not in GROUP_KEYS:
                self.problems.add(
                    value.key_place,
                    f"group {name!r}: unknown key {key[:80]!r}; settings belong to its stages, under `stages:`."
                    f"{did_you_mean(key, GROUP_KEYS)}",
                )
        if not isinstance(node.value.get("description", _TEXT).value, str):
            self.problems.add(node.value["description"].place, f"group {name!r}: description must be text")
        if not isinstance(node.value.get("stages", _NOTHING).value, dict | None):
            self.problems.add(node.value["stages"].place, f"group {name!r}: `stages:` must be a mapping of stage names")
        elif "stages" in node.value and node.value["stages"].value is None and name in self._groups:
            self.problems.add(
                node.value["stages"].key_place,
                f"group {name!r}: `stages:` is empty, which changes nothing; `{name}: null` removes the group",
            )
        return len(self.problems.lines) == before

    def _read(self, file: WorkflowFile, name: str, node: Located) -> tuple[Mapping[str, Located], str]:
        """Return the stages of a group from its file with what its entry changes, and what the file says it is."""
        inner = MergedStages(self.reader, self.problems)
        files = self.reader.read_group(node.value["group"], file)
        for each in files:
            inner.add(each)
        if inner._groups:
            self.problems.add(
                node.value["group"].place,
                f"group {name!r}: {files[-1].shown_as} contains groups itself ({', '.join(inner._groups)}), and groups "
                "contain only stages",
            )
        own = node.value.get("stages", _NOTHING).value or {}
        if files:
            known = inner.stages
            changes = {key: one for key, one in own.items() if not self._is_nested(one, key, group=name, known=known)}
            inner.apply(file, changes)
        self.group_files += [*files, *inner.group_files]
        self.written |= inner.written | own.keys()
        description = files[-1].root.value.get("description", _TEXT).value if files else ""
        return inner.stages, description if isinstance(description, str) else ""

    def _is_nested(self, entry: Located, name: str, *, group: str, known: Mapping[str, Located]) -> bool:
        """Return whether an entry in a group is a group and not one of the stages that are known, and report it."""
        if not is_group(entry) or name in known:
            return False
        self.problems.add(entry.key_place, f"group {group!r}: {name!r} is a group, too, and groups contain only stages")
        return True

    def _order(self, steps: Sequence[_Step]) -> list[str]:
        """Return the names of all stages, old and new, in order, and set the groups of the new ones."""
        order = list(self.stages)
        for idx, step in enumerate(steps):
            if step.kind is _Kind.REPLACE:
                order = self._replaced_order(order, step)
            elif step.kind is _Kind.STAGE and step.name not in order:
                place, joined = self._place(order, steps, idx)
                order.insert(place, step.name)
                if group := step.group or joined:
                    self.group_of[step.name] = group
        return order

    def _replaced_order(self, order: Sequence[str], step: _Step) -> list[str]:
        """Return the order with the new stages of a group at the place of its old ones."""
        place = min(order.index(stage) for stage in step.old)
        new = [stage for stage in step.node.value if stage in step.old or stage not in order]
        for stage in step.old:
            del self.group_of[stage]
        self.group_of |= dict.fromkeys(new, step.name)
        return [*order[:place], *new, *(stage for stage in order[place:] if stage not in step.old)]

    def _place(self, order: Sequence[str], steps: Sequence[_Step], idx: int) -> tuple[int, str]:
        """Return the position of a new stage, and the group of the neighbour that it is written beside."""
        step = steps[idx]
        before, behind = steps[:idx][::-1], steps[idx + 1 :]
        if step.is_inside:
            before, behind = ([one for one in part if one.group == step.group] for part in (before, behind))
        for neighbours, offset in ((before, 1), (behind, 0)):
            for other in neighbours:
                known = [other.name] if other.kind is _Kind.STAGE else self._members(order, other.name)
                places = [order.index(name) for name in known if name in order]
                if places:
                    is_beside = other.kind is _Kind.STAGE and not other.group
                    return (max(places) + 1 if offset else min(places)), (
                        self.group_of.get(other.name, "") if is_beside else ""
                    )
        members = self._members(order, step.group)
        return (order.index(members[-1]) + 1 if members else len(order)), ""

    def _members(self, order: Sequence[str], group: str) -> tuple[str, ...]:
        return tuple(name for name in order if group and self.group_of.get(name) == group)

    def _apply(self, step: _Step, file: WorkflowFile) -> None:
        if step.kind is _Kind.STAGE:
            self._apply_stage(step, file)
            return
        verb = "removed" if step.kind is _Kind.REMOVE else "replaced"
        if step.kind is _Kind.REMOVE:
            self.removed[step.name] = Removed(f"was removed ({step.node.key_place})")
        for name in step.old:
            if (node := self.stages.pop(name, None)) is not None:
                how = f"was {verb} with the group {step.name!r} ({step.node.key_place})"
                self.removed[name] = Removed(how, node.value["use"].value)
            self._first_file.pop(name, None)
            if step.kind is _Kind.REMOVE:
                self.group_of.pop(name, None)

    def _apply_stage(self, step: _Step, file: WorkflowFile) -> None:
        name, node = step.name, step.node
        if node.value is not None:
            self.written.add(name)
        if name in self._groups and name not in self.stages and not self._takes_name(step, file):
            return
        if step.group and name in self.stages and self.group_of.get(name) != step.group:
            brought_by = self._first_file.get(name, "")
            if brought_by == file.shown_as or brought_by in file.inherits:
                where = f"in the group {self.group_of[name]!r}" if name in self.group_of else "beside the groups"
                self.problems.add(
                    node.key_place,
                    f"group {step.group!r}: stage {name!r} is {where} already ({self.stages[name].key_place}); "
                    "write it there, or give it another name",
                )
                return
        if node.value is None and name in self.stages:
            self.removed[name] = Removed(f"was removed ({node.key_place})", self.stages[name].value["use"].value)
        _merge_entry(self.stages, name, node, problems=self.problems)
        if name in self.stages:
            self._first_file.setdefault(name, file.shown_as)
            if step.group:
                self.group_of.setdefault(name, step.group)

    def _takes_name(self, step: _Step, file: WorkflowFile) -> bool:
        """Return whether a new stage may have the name of a group: it may if the group is of another file.

        Workflows that were written before the groups of a preset are valid; the group then has no name.
        """
        group = self._groups[step.name]
        if step.group or file.shown_as in group.files:
            self.problems.add(step.node.key_place, f"stage {step.name!r} has the name of a group; give it another name")
            return False
        self.notes.append(
            f"{step.node.key_place}: stage {step.name!r} has the name of a group of {', '.join(sorted(group.files))}, "
            "which can therefore not be named; give the stage another name"
        )
        for name in self._members(list(self.group_of), step.name):
            del self.group_of[name]
        return True


_TEXT, _NOTHING = Located("", 0, 0), Located(None, 0, 0)


def is_group(node: Located) -> bool:
    """Return whether an entry under `stages:` describes a group; one that overrides a stage may look the same."""
    return (
        isinstance(node.value, dict)
        and "use" not in node.value
        and any(key in node.value for key in ("group", "stages"))
    )


def _mapping_like(node: Located, value: Mapping[str, Located]) -> Located:
    return Located(dict(value), node.line, node.column, node.key_line, node.key_column, node.origin, node.file)


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
