"""What differs between two runs, and why: settings, code, images, metrics, poses, ranges, files and the verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pano_mvs.core.digest import IS_DIGEST
from pano_mvs.core.errors import UsageError
from pano_mvs.core.paths import exists
from pano_mvs.core.text import finite_or_none, plural, shortened_list
from pano_mvs.session.code_listing import changed_functions, read_code_listing
from pano_mvs_lineage.alignment import MOVED_SHARE, TURNED_DEG, align_runs, camera_changes
from pano_mvs_lineage.range_changes import CLASSES, RangeChange, range_changes
from pano_mvs_lineage.stored_runs import StoredRun


@dataclass(frozen=True)
class Change:
    """One value in both runs; None where a run lacks it."""

    name: str
    before: Any
    after: Any

    def __str__(self) -> str:
        return f"{self.name}: {_text(self.before)} → {_text(self.after)}"


@dataclass(frozen=True)
class CameraChange:
    """How far a camera stands from where the other run has it, after both were aligned."""

    name: str
    moved: float  # relative to the largest distance between two cameras
    turned_deg: float


@dataclass(frozen=True)
class PoseChanges:
    """The cameras of two runs; those of the largest group are aligned by the ones that stayed where they were."""

    only_before: tuple[str, ...] = ()
    only_after: tuple[str, ...] = ()
    cameras: tuple[CameraChange, ...] = ()  # that both runs have, the one that moved farthest first
    note: str = ""  # why they were not compared; empty if they were

    @property
    def moved(self) -> tuple[CameraChange, ...]:
        """Those that moved by .2 % of the capture's extent, or turned by .1°, and more."""
        return tuple(one for one in self.cameras if one.moved >= MOVED_SHARE or one.turned_deg >= TURNED_DEG)


@dataclass(frozen=True)
class DiffPart:
    """What differs in one respect, as lines, and as a table where there are many figures."""

    title: str
    lines: tuple[str, ...]
    columns: tuple[str, ...] = ()  # of the table; empty if there is none
    rows: tuple[tuple[str, ...], ...] = ()

    @property
    def text(self) -> list[str]:
        """The title and the lines below it."""
        return [f"{self.title}:", *(f"  {line}" for line in self.lines)]


@dataclass(frozen=True)
class RunDiff:
    """What differs between two runs; empty parts are equal."""

    before: Path
    after: Path
    stages: tuple[Change, ...] = ()  # stage that one run lacks, or that is another one, to what it uses
    settings: tuple[Change, ...] = ()  # `STAGE.SETTING` of stages that are the same in both
    versions: tuple[Change, ...] = ()  # of the program, Python and libraries
    # stage to why its units are not the same: its settings, code, libraries, or the stages behind its inputs
    reasons: Mapping[str, str] = field(default_factory=dict)
    images: tuple[Change, ...] = ()  # image to the digest of its file
    metrics: tuple[Change, ...] = ()  # `STAGE.METRIC`
    poses: PoseChanges = PoseChanges()
    ranges: tuple[RangeChange, ...] = ()  # of the views that both runs have
    files: tuple[Change, ...] = ()  # delivered file to its digest
    outcome: tuple[Change, ...] = ()  # exit code, judgement, points of the cloud
    notes: tuple[str, ...] = ()  # what could not be compared, and why

    @property
    def is_same(self) -> bool:
        """Whether both runs have the same settings, images, code and files, as far as they could be compared."""
        return not (self.stages or self.settings or self.reasons or self.images or self.files or self.outcome)

    def to_json(self) -> dict[str, Any]:
        """Return the differences as JSON values."""
        values = asdict(self)
        values |= {"before": str(self.before), "after": str(self.after), "same": self.is_same}
        plain: dict[str, Any] = _plain(values)
        return plain

    def parts(self) -> list[DiffPart]:
        """Return the differences in parts, the most telling first; parts that are equal are left out."""
        if self.is_same:
            same = "the same settings, images, code and files"
            return [DiffPart(f"{same}, as far as they could be compared" if self.notes else same, self.notes)]
        reasons = tuple(f"{stage}: {reason}" for stage, reason in self.reasons.items())
        parts = [
            DiffPart("notes", self.notes),
            DiffPart("outcome", tuple(map(str, self.outcome))),
            DiffPart("stages", tuple(map(str, self.stages))),
            DiffPart("settings", tuple(map(str, self.settings))),
            DiffPart("versions", tuple(map(str, self.versions))),
            DiffPart("why units differ", reasons),
            DiffPart("images", tuple(_image_lines(self.images))),
            DiffPart(
                "metrics", tuple(map(str, self.metrics)), ("metric", "before", "after"), _metric_rows(self.metrics)
            ),
            DiffPart("poses", tuple(_pose_lines(self.poses))),
            DiffPart("ranges", tuple(map(str, self.ranges)), _RANGE_COLUMNS, _range_rows(self.ranges)),
            DiffPart("files", tuple(_file_lines(self.files))),
        ]
        return [part for part in parts if part.lines]

    def lines(self) -> list[str]:
        """Return the differences as text."""
        if self.is_same and not self.notes:
            return [self.parts()[0].title]
        return [line for part in self.parts() for line in part.text]


def diff(before: str | Path, after: str | Path, *, cache: str | Path | None = None) -> RunDiff:
    """Return what differs between two runs, and why.

    >>> import pano_mvs
    >>> pano_mvs.diff("out/first", "out/second").settings  # doctest: +SKIP
    (Change(name='depth.planes', before=128, after=192),)

    Args:
        before: the output folder of a run.
        after: that of another one.
        cache: the cache of both; None for the ones that their run.json name. Without a cache, what files say is
            compared, and no reasons are given.

    Raises:
        InputError: if a folder has no run.json that can be read.
        UsageError: if both are the same folder.
    """
    first, second = Path(before), Path(after)
    if first.resolve() == second.resolve():
        raise UsageError(f"{first} and {second} are the same folder. Give the output folders of two runs")
    root = None if cache is None else Path(cache)
    old, new = StoredRun.open(first, root), StoredRun.open(second, root)
    notes = [*old.notes, *(note for note in new.notes if note not in old.notes)]
    notes += [note for run in (old, new) for note in (run.unlisted, _missing_files(run)) if note]
    images = _images(old, new)
    if note := _different_captures(old, new):
        notes.insert(0, note)
    poses = _poses(old, new)
    return RunDiff(
        before=first,
        after=second,
        stages=_changes(_uses(old), _uses(new)),
        settings=_changes(*_common_settings(old, new)),
        versions=_listed(old.summary.versions, new.summary.versions),
        reasons=reasons_between(old, new),
        images=images,
        metrics=tuple(change for change in _listed(old.metrics, new.metrics) if not _is_close(change)),
        poses=poses,
        ranges=range_changes(old, new),
        files=_changes(old.summary.files, new.summary.files),
        outcome=_changes(_outcome(old), _outcome(new)),
        notes=tuple(notes),
    )


def reasons_between(old: StoredRun, new: StoredRun) -> dict[str, str]:
    """Return for each stage of both runs why its units are not the same; stages without a difference are left out.

    A stage whose inputs alone differ names the stages that made these. The order is that of the workflow.
    """
    found: dict[str, str] = {}
    order = [outcome.name for outcome in new.summary.stages]
    for stage in sorted(new.keys, key=lambda name: order.index(name) if name in order else len(order)):
        before, after = old.keys.get(stage), new.keys[stage]
        if before is None or before == after:
            continue
        common = [item for item in after if item in before]
        changed = [item for item in common if before[item] != after[item]]
        parts = []
        if added := len(after) - len(common):
            parts.append(f"{added} {plural(added, 'unit')} more")
        if removed := len(before) - len(common):
            parts.append(f"{removed} {plural(removed, 'unit')} fewer")
        for item in changed:
            one, other = old.record(stage, item), new.record(stage, item)
            if one is not None and other is not None:
                codes = [
                    read_code_listing(run.out, stage, str(record.identity.get("code")))
                    for run, record in ((old, one), (new, other))
                ]
                functions = changed_functions(*codes)
                parts.append(
                    _reason(one.identity, other.identity, producers=new.producers.get(stage, {}), functions=functions)
                )
                break
        else:
            if changed:
                parts.append("the cache no longer has what its units were made of")
        if 0 < len(changed) < len(common):
            parts.append(f"{len(changed)} of {len(common)} units")
        found[stage] = "; ".join(part for part in parts if part)
    return found


def _reason(
    before: Mapping[str, Any], after: Mapping[str, Any], *, producers: Mapping[str, str], functions: Sequence[str]
) -> str:
    """Return why two identities of a unit differ.

    Args:
        producers: port to the stage that feeds it.
        functions: those of its code that differ, by file, as far as they are known.
    """
    parts = []
    if before.get("stage") != after.get("stage"):
        return f"stage {before.get('stage')} → {after.get('stage')}"
    params = _changes(before.get("params", {}), after.get("params", {}))
    parts += [
        f"content of the setting {change.name}" if _are_digests(change) else f"setting {change}" for change in params
    ]
    if before.get("version") != after.get("version"):
        parts.append(f"version {before.get('version')} → {after.get('version')}")
    if before.get("code") != after.get("code"):
        which = f" ({shortened_list(list(functions), 8)})" if functions else ""
        parts.append(f"code of {after.get('stage')}{which}")
    parts += [f"library {change}" for change in _changes(before.get("libraries", {}), after.get("libraries", {}))]
    parts += [f"kind {change}" for change in _changes(before.get("kinds", {}), after.get("kinds", {}))]
    inputs = _changes(before.get("inputs", {}), after.get("inputs", {}))
    if inputs:
        named = dict.fromkeys(producers.get(change.name, change.name) for change in inputs)
        parts.append(f"inputs of {', '.join(named)}")
    if before.get("schema") != after.get("schema"):
        parts.append("keys of another version of the program")
    return ", ".join(parts) or "keys of another version of the program"


def _are_digests(change: Change) -> bool:
    """Return whether a setting names files, which an identity has as a list of the digests of their contents."""
    both = change.before, change.after
    return all(
        isinstance(value, list) and value and all(IS_DIGEST.fullmatch(str(one)) for one in value) for value in both
    )


def digests_in(value: Any) -> list[str]:
    """Return the digests in one input of an identity: a digest, a list of them, or pairs of a name and a digest."""
    if isinstance(value, str):
        return [value]
    if not isinstance(value, list | tuple):
        return []
    return [str(entry[1]) if isinstance(entry, list | tuple) and len(entry) == 2 else str(entry) for entry in value]


def _changes(before: Mapping[str, Any], after: Mapping[str, Any]) -> tuple[Change, ...]:
    names = dict.fromkeys([*before, *after])
    found = (Change(name, before.get(name), after.get(name)) for name in names)
    return tuple(change for change in found if change.before != change.after)


def _is_close(change: Change) -> bool:
    """Return whether a metric differs by less than a millionth, as on another processor."""
    both = change.before, change.after
    return None not in both and math.isclose(*both, rel_tol=1e-6, abs_tol=1e-12)


def _uses(run: StoredRun) -> dict[str, str]:
    return {stage.name: stage.use for stage in run.summary.stages}


def _common_settings(old: StoredRun, new: StoredRun) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the settings of the stages that are the same in both runs."""
    same = {name for name, use in _uses(old).items() if _uses(new).get(name) == use}
    both = (
        {name: value for name, value in run.settings.items() if name.partition(".")[0] in same} for run in (old, new)
    )
    before, after = both
    return before, after


def _named(old: StoredRun, new: StoredRun) -> tuple[dict[str, str], dict[str, str]]:
    """Return the digests of the images of both runs by their names: without folders, unless two of a run are equal.

    With folders, these begin below the one that all images of the run share, which may lie elsewhere for the other.
    """
    both = [run.summary.inputs for run in (old, new)]
    if all(len({Path(path).name for path in inputs}) == len(inputs) for inputs in both):
        before, after = ({Path(path).name: digest for path, digest in inputs.items()} for inputs in both)
    else:
        before, after = (below_common_folder(inputs) for inputs in both)
    return before, after


def below_common_folder(inputs: Mapping[str, str]) -> dict[str, str]:
    """Return the paths of files below the folder that all share, each with its digest."""
    folders = [Path(path).parent for path in inputs]
    above = [one for first in folders[:1] for one in (first, *first.parents)]
    shared = next((one for one in above if all(folder.is_relative_to(one) for folder in folders)), Path())
    return {
        (Path(path).relative_to(shared) if Path(path).is_relative_to(shared) else Path(path)).as_posix(): digest
        for path, digest in inputs.items()
    }


def _images(old: StoredRun, new: StoredRun) -> tuple[Change, ...]:
    return _listed(*_named(old, new))


def _listed(before: Mapping[str, Any], after: Mapping[str, Any]) -> tuple[Change, ...]:
    """Return the changes, or none if a run of an earlier version lists nothing of the kind."""
    return _changes(before, after) if before and after else ()


def _different_captures(old: StoredRun, new: StoredRun) -> str:
    """Return a note if two runs have no image in common, by name or by content; "" if they have, or do not list any."""
    before, after = _named(old, new)
    if not before or not after:
        return ""
    if not before.keys() & after.keys():
        return "the runs are of different captures: they have no image in common, and poses and ranges are not compared"
    if not {*before.values()} & {*after.values()}:
        return (
            "the runs are probably of different captures: no image of theirs is the same, although some have the same "
            "name. Metrics, poses and ranges then do not compare"
        )
    return ""


def _missing_files(run: StoredRun) -> str:
    """Return a note on delivered files that are no longer there; "" if all are."""
    gone = [name for name in run.summary.files if not exists(run.out / name)]
    return f"no longer in {run.out}: {shortened_list(gone, 8)}" if gone else ""


def _outcome(run: StoredRun) -> dict[str, Any]:
    verdict = run.summary.verdict
    return {
        "exit code": run.summary.exit_code,
        "verdict": verdict.judgement if verdict is not None else "",
        "stopped": run.summary.stopped,
        "registered cameras": len(run.summary.poses.registered),
        "points of the cloud": run.summary.cloud.points,
    }


def _poses(old: StoredRun, new: StoredRun) -> PoseChanges:
    one, other = old.output.poses, new.output.poses
    if one is None or other is None:
        return PoseChanges(note="a run has no poses" if (one is None) != (other is None) else "")
    before, after = one.cameras, other.cameras
    only = tuple(name for name in before if name not in after), tuple(name for name in after if name not in before)
    groups = [dict(zip(poses.names, poses.groups.tolist(), strict=True)) for poses in (one, other)]
    common = [name for name in before if name in after and groups[0][name] == groups[1][name] == 0]
    if len(common) < 2:
        return PoseChanges(*only, note="fewer than two cameras of the largest groups are the same")
    before, after = ({name: cameras[name] for name in common} for cameras in (before, after))
    try:
        aligned = align_runs(before, after)
    except UsageError as error:
        return PoseChanges(*only, note=str(error))
    found = [
        CameraChange(name, float(share), float(turn_deg))
        for name, share, turn_deg in zip(common, *camera_changes(aligned, before, after), strict=True)
    ]
    return PoseChanges(*only, tuple(sorted(found, key=lambda one: (-one.moved, one.name))))


def _image_lines(images: tuple[Change, ...]) -> list[str]:
    parts = (
        ("only before", [one.name for one in images if one.after is None]),
        ("only after", [one.name for one in images if one.before is None]),
        ("other content", [one.name for one in images if None not in (one.before, one.after)]),
    )
    return [f"{what}: {shortened_list(names, 8)}" for what, names in parts if names]


def _metric_rows(metrics: tuple[Change, ...]) -> tuple[tuple[str, ...], ...]:
    return tuple((one.name, _text(one.before), _text(one.after)) for one in metrics)


_RANGE_COLUMNS = ("view", "differ by over 1 %", *CLASSES, "only before", "only after")


def _range_rows(ranges: tuple[RangeChange, ...]) -> tuple[tuple[str, ...], ...]:
    return tuple(
        (
            one.name,
            f"{one.changed:.1%}",
            *(f"{one.by_class[name]:.1%}" if name in one.by_class else "–" for name in CLASSES),
            f"{one.only_before:.1%}",
            f"{one.only_after:.1%}",
        )
        for one in ranges
    )


def _file_lines(files: tuple[Change, ...]) -> list[str]:
    return _image_lines(files)


def _pose_lines(poses: PoseChanges) -> list[str]:
    lines = [
        f"{what}: {shortened_list(list(names), 8)}"
        for what, names in (("only before", poses.only_before), ("only after", poses.only_after))
        if names
    ]
    if moved := poses.moved:
        lines.append(f"{len(moved)} of {len(poses.cameras)} cameras moved by .2 % of the extent or .1°, and more:")
        lines += [f"  {one.name}: {100 * one.moved:.2f} %, {one.turned_deg:.2f}°" for one in moved[:20]]
    elif poses.cameras and poses.cameras[0].moved > 1e-9:
        most = poses.cameras[0]
        lines.append(f"{len(poses.cameras)} cameras moved by at most {100 * most.moved:.3f} % of the extent")
    return [*lines, *([poses.note] if poses.note else [])]


def _text(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _plain(value: Any) -> Any:
    """Return values for JSON: paths as text, no NaN."""
    if isinstance(value, Mapping):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, float):
        return finite_or_none(value)
    return value if isinstance(value, str | int | bool | None) else str(value)
