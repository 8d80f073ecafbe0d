"""The way from a delivered file back to the unit that made it, and to the images."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pano_mvs.core.digest import digest_from_file
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.file_names import is_of_the_run
from pano_mvs.core.paths import children, is_file, resolved
from pano_mvs.core.text import plural, shortened_list
from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.cache.dropping import dropping_after
from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.running.publish import delivered_files
from pano_mvs.results.origin import ORIGIN, Origin, RunName
from pano_mvs.results.summary import RUN_JSON
from pano_mvs.scene.files import item_stems
from pano_mvs.session.running import Execution, run_session
from pano_mvs.session.session import RunOptions, reopen
from pano_mvs_lineage.diff import below_common_folder, digests_in
from pano_mvs_lineage.stored_runs import StoredRun, as_paths, find_runs

REPORT = "report.html"
_MOST_IMAGES = 12  # names on the terminal: a tour of tiles has thousands
_COMMANDS = {"ro-crate-metadata.json": "crate"}  # what a command writes into the folder of a run


@dataclass(frozen=True)
class UnitOrigin:
    """A unit that leads to a file."""

    stage: str  # its name in the workflow
    use: str  # the registered stage
    item: str  # image, pair or view; empty if the stage has one unit
    key: str  # in the cache
    settings: Mapping[str, Any]
    code: str  # digest of the code that computed it
    libraries: Mapping[str, str]
    seconds: float  # that it took
    depth: int = 0  # number of units between it and the file
    group: str = ""  # the group of stages that its stage belongs to

    @property
    def label(self) -> str:
        """`STAGE:ITEM`, or `STAGE` if the stage has one unit."""
        return f"{self.stage}:{self.item}" if self.item else self.stage

    @property
    def what(self) -> str:
        """The registered stage, and the group of stages that it is in."""
        return f"{self.use}, in {self.group}" if self.group else self.use


@dataclass(frozen=True)
class FileOrigin:
    """Where a file comes from."""

    file: Path
    name: str  # of the file in the output folder of its run, or in that of the command that made it
    out: Path  # the output folder of its run, or of the first run that it was made from
    workflow: str
    started: str
    version: str  # of pano_mvs
    units: tuple[UnitOrigin, ...]  # the one that made the file first, then those that it depends on, nearest first
    images: Mapping[str, str]  # path of each image that it depends on to its digest; of the whole run if unknown
    was_changed: bool = False  # whether the file has other bytes than the run wrote
    notes: tuple[str, ...] = ()
    command: str = ""  # the command that made the file from runs, such as `share`; empty if a run wrote it

    def to_json(self) -> dict[str, Any]:
        """Return the origin as JSON values."""
        return asdict(self) | {"file": str(self.file), "out": str(self.out)}

    def lines(self) -> list[str]:
        """Return the origin as text: the unit that made the file, and a line for each stage that it depends on."""
        what = f"made by pano-mvs {self.command} from" if self.command else f"{self.name} of"
        lines = [
            f"{self.file}: {what} the run into {self.out}",
            f"workflow {self.workflow}, started {self.started or 'at an unknown time'}, pano_mvs {self.version}",
        ]
        if self.was_changed:
            lines.append("the file has other bytes than the run wrote: it was changed since")
        for unit in self.units[:1]:  # the one that made the file
            settings = ", ".join(f"{name}={value}" for name, value in unit.settings.items())
            lines.append(f"{unit.label} ({unit.what}), {unit.seconds:.2f} s, {unit.key[:12]}")
            lines += [f"  settings: {settings}"] if settings else []
            lines += [f"  code: {unit.code}"] if unit.code else []
        by_stage: dict[str, list[UnitOrigin]] = {}
        for unit in self.units[1:]:
            by_stage.setdefault(unit.stage, []).append(unit)
        for stage, units in by_stage.items():
            seconds = math.fsum(unit.seconds for unit in units)
            which = f"{units[0].label} ({units[0].what})" if len(units) == 1 else f"{stage} ({units[0].what})"
            key = units[0].key[:12] if len(units) == 1 else f"{len(units)} units"
            lines.append(f"  {which}, {seconds:.2f} s, {key}")
        images = shortened_list(list(below_common_folder(self.images)), _MOST_IMAGES)
        lines.append(f"images: {images or 'run.json does not list them'}")
        return [*lines, *self.notes]


def why(
    file: str | Path, *, runs: str | Path | Iterable[str | Path] = (), cache: str | Path | None = None
) -> FileOrigin:
    """Return where a delivered file comes from: its run, the unit that made it, and all that this depends on.

    A file in the output folder of a run is found by its place. One that was copied or renamed is found by its content:
    in the run in whose folder it lies, and in the runs, shared pages and experiments in the folders `runs`. A file of a
    page or an experiment leads to the runs that it was made from, which are looked for there as well.

    >>> import pano_mvs
    >>> pano_mvs.why("out/range/000.tiff").units[0].label  # doctest: +SKIP
    'ranges:000.png'

    Args:
        runs: folders in which runs are looked for, if the file lies in none.
        cache: of the run; None for the one that run.json names.

    Raises:
        InputError: if the file does not exist, or no run has written it.
    """
    path = Path(os.path.normpath(file))  # without `..`, and with links as they are
    if not is_file(path):
        raise InputError(f"{path}: there is no such file. Give a file that a run has written")
    root = None if cache is None else Path(cache)
    place = _folder_above(path)
    made_by = Origin.read(place) if place is not None and not is_file(place / RUN_JSON) else None
    if made_by is None and place is not None and not is_file(place / RUN_JSON):
        place = None  # what the command has left there cannot be read
    searched = as_paths(runs) if runs else []
    if place is not None and made_by is not None:
        return _derived(
            path, path.absolute().relative_to(place.absolute()), made_by, folder=place, searched=searched, root=root
        )
    digest = digest_from_file(path)
    if place is not None:
        run, name = StoredRun.open(place, root), path.absolute().relative_to(place.absolute()).as_posix()
        if run.summary.merged is not None:
            return _merged(path, name, run, root)
        if name in run.summary.files:
            return _origin(path, name, run, was_changed=digest != run.summary.files[name])
        if found := _beside(path, name, run) or _delivered(path, digest, run):
            return found
        if not runs:
            raise InputError(f"{path}: the run into {place} has not written this file, or an earlier run has")
    return _by_content(path, digest, searched, root)


def _by_content(path: Path, digest: str, searched: list[Path], root: Path | None) -> FileOrigin:
    """Return the origin of a file that was copied: the same bytes are looked for in folders.

    Args:
        searched: the folders; empty for the current one.

    Raises:
        InputError: if no file there has the same content.
    """
    below = searched or [Path()]
    opened = list(_readable(below, root))
    for run in opened:
        if found := _delivered(path, digest, run):
            return found
    for run in opened:
        for name in (RUN_JSON, REPORT, *_COMMANDS, *(f"logs/{log.name}" for log in children(run.out / "logs"))):
            found = _beside(path, name, run) if _is_copy(path, digest, run.out / name) else None
            if found is not None:
                return found
        if run.summary.merged is not None:
            copied = next((one for one in _files_below(run.out, is_run=True) if _is_copy(path, digest, one)), None)
            if copied is not None:
                return _merged(path, copied.relative_to(run.out).as_posix(), run, root)
    for folder in _folders_of_commands(below):
        made_by = Origin.read(folder)
        copied = next((one for one in _files_below(folder) if _is_copy(path, digest, one)), None)
        if made_by is not None and copied is not None:
            return _derived(path, copied.relative_to(folder), made_by, folder=folder, searched=searched, root=root)
    where = ", ".join(map(str, searched)) or "the current folder"
    raise InputError(f"{path}: no run in {where} has written a file with this content. Name its folder with --runs")


def _delivered(path: Path, digest: str, run: StoredRun) -> FileOrigin | None:
    """Return the origin of a copy of a file that a run delivered; None if the run delivered no such content."""
    names = [name for name, own in run.summary.files.items() if own == digest]
    if not names:
        return None
    others = f"other files of the run have the same content: {shortened_list(names[1:])}" if names[1:] else ""
    found = _origin(path, names[0], run)
    return replace(found, notes=(*found.notes, others)) if others else found


def _beside(path: Path, name: str, run: StoredRun) -> FileOrigin | None:
    """Return the origin of a file in the folder of a run that no unit made; None if it is unknown."""
    if is_of_the_run(name):
        when = "during" if name.startswith("logs/") else "at the end of"
        note = f"{name} is written by the run itself, {when} each run, from the results of all stages"
        return _origin(path, name, run, note=note)
    if name in _COMMANDS:
        found = _origin(path, name, run, note=f"{name} describes the whole run; ask about a file of it for its units")
        return replace(found, command=_COMMANDS[name])
    return None


def _is_copy(path: Path, digest: str, other: Path) -> bool:
    """Return whether another file can be read and has the same content."""
    try:
        return is_file(other) and other.stat().st_size == path.stat().st_size and digest_from_file(other) == digest
    except OSError:  # it may not be read, or is gone by now
        return False


def _folders_of_commands(folders: Iterable[Path]) -> Iterator[Path]:
    """Yield the folders below some that a command made from runs."""
    for top in folders:
        for folder, names, files in os.walk(top):
            names[:] = [name for name in names if not name.startswith(".")]
            if ORIGIN in files:
                yield Path(folder)


def _merged(path: Path, name: str, run: StoredRun, root: Path | None) -> FileOrigin:
    """Return the origin of a file in the folder of a merged run: the runs of its blocks."""
    folders = run.summary.merged.blocks if run.summary.merged is not None else ()
    images: dict[tuple[str, str], str] = {}  # blocks share images, each by a link of its own
    for block in _readable([Path(folder) for folder in folders], root):
        for image, digest in block.summary.inputs.items():
            images.setdefault((Path(image).name, digest), image)
    note = f"merged from {len(folders)} {plural(len(folders), 'block')}: {shortened_list(list(map(str, folders)))}"
    return FileOrigin(
        path,
        name,
        run.out,
        workflow=run.summary.workflow.name,
        started=run.summary.started,
        version=run.summary.version,
        units=(),
        images={image: digest for (_, digest), image in images.items()},
        notes=(f"{note}; ask about a file of a block for its units",),
        command="merge",
    )


def _files_below(folder: Path, *, is_run: bool = False) -> Iterator[Path]:
    """Yield the files in a folder that a command made, without those of the runs in it.

    Args:
        is_run: whether the folder itself is that of a run.
    """
    for inner, names, files in os.walk(folder):
        if RUN_JSON in files and not (is_run and Path(inner) == folder):
            names.clear()
            continue
        yield from (Path(inner, name) for name in files if not name.startswith("."))


@dataclass(frozen=True)
class Repeated:
    """A unit that was computed again."""

    label: str
    is_same: bool  # whether it made the same bytes
    seconds: float


def repeat(origin: FileOrigin, *, cache: str | Path | None = None) -> Repeated:
    """Compute the unit that made a file again, alone, and compare its bytes.

    Raises:
        UsageError: if the unit is not known, or its workflow has changed so that it would have another key.
        InputError: if the workflow or the images of the run are no longer there.
    """
    if not origin.units:
        why_not = "; ".join(origin.notes) or "the cache of the run is not there"
        raise UsageError(f"{origin.file}: there is no unit to compute again: {why_not}")
    unit = origin.units[0]
    session = reopen(str(origin.out), overrides=[], images=None, cache=None if cache is None else Path(cache))
    before = StoredRun.open(origin.out, session.store_root).record(unit.stage, unit.item)
    with TemporaryDirectory(prefix="pano-mvs-why-") as folder, dropping_after([session.store_root]):
        out, options = Path(folder) / "out", RunOptions(only=(unit.label,), refresh=(unit.label,))
        try:
            output = run_session(replace(session, out=out, run_options=options), Execution(executor="serial"))
            after = StoredRun.open(out, session.store_root).record(unit.stage, unit.item)
        finally:
            history = Store(session.store_root).runs
            for entry in history.entries():  # of a folder that is about to be deleted
                if entry.out == str(resolved(out)) and not entry.pinned:
                    history.forget(entry)
    if before is None or after is None or before.key != after.key:
        raise UsageError(
            f"{unit.label} cannot be computed again as it was: the workflow, the code or the images have changed since"
        )
    seconds = next((stage.unit_seconds or 0.0 for stage in output.summary.stages if stage.name == unit.stage), 0.0)
    return Repeated(unit.label, before.output.digest == after.output.digest, seconds)


def _folder_above(path: Path) -> Path | None:
    """Return the output folder of the run in which a file lies, or of a command that made files from runs, or None."""
    folders = path.absolute().parents
    return next((folder for folder in folders if is_file(folder / RUN_JSON) or is_file(folder / ORIGIN)), None)


def _derived(
    path: Path, name: Path, origin: Origin, *, folder: Path, searched: list[Path], root: Path | None
) -> FileOrigin:
    """Return the origin of a file that a command made from runs.

    Args:
        name: of the file in the folder of the command.
        folder: that the command wrote; an experiment has its runs below it.
        searched: folders in which the runs of a page are looked for; if there is none, the current folder.

    Raises:
        InputError: if none of the runs is found.
    """
    below = (searched or [Path()]) if origin.runs else [folder]
    runs = [run for run in _readable(below, root) if not origin.runs or RunName.of(run.summary) in origin.runs]
    if not runs:
        which = ", ".join(f"{run.workflow}, started {run.started}" for run in origin.runs)
        raise InputError(
            f"{path}: pano-mvs {origin.command} made this file, but no run that it was made from is in "
            f"{shortened_list(list(map(str, below)))}{f' ({which})' if which else ''}. Name its folder with --runs"
        )
    first = runs[0]
    images = {image: digest for run in runs for image, digest in run.summary.inputs.items()}
    outs = shortened_list([str(run.out) for run in runs])
    note = f"made from {len(runs)} {plural(len(runs), 'run')}: {outs}; ask about a file of a run for its units"
    return FileOrigin(
        path,
        name.as_posix(),
        first.out,
        workflow=first.summary.workflow.name,
        started=first.summary.started,
        version=first.summary.version,
        units=(),
        images=images,
        notes=(note,),
        command=origin.command,
    )


def _readable(folders: list[Path], root: Path | None) -> Iterator[StoredRun]:
    """Yield the runs in some folders, without those that cannot be read."""
    for folder in folders:
        try:
            outs = find_runs([folder])
        except InputError:
            continue
        for out in outs:
            with suppress(InputError):
                yield StoredRun.open(out, root)


def _origin(path: Path, name: str, run: StoredRun, *, was_changed: bool = False, note: str = "") -> FileOrigin:
    summary = run.summary
    notes = [*run.notes, *([note] if note else [])]
    units: tuple[UnitOrigin, ...] = ()
    if not note:
        found = _maker(run, name)
        if found is None and run.store is not None:
            notes.append("the cache no longer has the unit that made it")
        units = tuple(_with_sources(run, *found)) if found is not None else ()
    images = dict(summary.inputs)
    used = {unit.item for unit in units if unit.use.startswith("source.")}
    if used:
        images = {image: digest for image, digest in images.items() if _is_one_of(image, used)} or images
    about = {"workflow": summary.workflow.name, "started": summary.started, "version": summary.version}
    return FileOrigin(
        path, name, run.out, **about, units=units, images=images, was_changed=was_changed, notes=tuple(notes)
    )


def _is_one_of(path: str, items: Iterable[str]) -> bool:
    place = path.replace(os.sep, "/")
    return any(place == item or place.endswith(f"/{item}") for item in items)


def _maker(run: StoredRun, name: str) -> tuple[str, str, UnitRecord] | None:
    """Return the stage, the item and the record of the unit that delivered a file; None if the cache lacks it.

    Several units may have made the same bytes: an image that is copied unchanged is also that of the source.
    """
    digest = run.summary.files[name]
    same = [
        (stage, item, record)
        for stage in run.keys
        for item, record in run.records(stage)
        if any(part.digest == digest for part in record.output.parts.values())
    ]
    sources = [outcome.name for outcome in run.summary.stages if outcome.use.startswith("source.")]
    stems = item_stems(dict.fromkeys(item for stage in sources for item in run.keys.get(stage, {})))
    return next((one for one in same if _delivers(run, one, name, stems)), same[0] if same else None)


def _delivers(run: StoredRun, unit: tuple[str, str, UnitRecord], name: str, stems: Mapping[str, str]) -> bool:
    """Return whether a unit delivers a file, in the folder of its stage or elsewhere."""
    _, item, record = unit
    if run.store is None:
        return False
    try:
        targets = [target for target, _ in delivered_files(record.output, run.store)]
    except DamagedBlobError:  # it delivers no files
        return False
    placed = (target.replace("{item}", stems.get(item, item)).replace("{name}", item) for target in targets)
    return any(name == target or name.endswith(f"/{target}") for target in placed)


def _with_sources(run: StoredRun, stage: str, item: str, record: UnitRecord) -> Iterator[UnitOrigin]:
    """Yield a unit and all units that it depends on, the nearest first."""
    uses = {outcome.name: outcome.use for outcome in run.summary.stages}
    groups = {outcome.name: outcome.group for outcome in run.summary.stages}
    pending, seen = [(stage, item, record, 0)], {(stage, item)}
    while pending:
        name, unit, made, depth = pending.pop(0)
        identity = made.identity
        yield UnitOrigin(
            name,
            uses.get(name, str(identity.get("stage", ""))),
            unit,
            made.key,
            dict(identity.get("params") or {}),
            str(identity.get("code") or ""),
            dict(identity.get("libraries") or {}),
            made.seconds,
            depth,
            groups.get(name, ""),
        )
        for port, value in (identity.get("inputs") or {}).items():
            for digest in digests_in(value):
                found = run.made_by(name, port, digest)
                if found is not None and found[:2] not in seen:
                    seen.add(found[:2])
                    pending.append((*found, depth + 1))
