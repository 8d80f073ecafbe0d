"""The part of the contract that stages which return files keep: where, of which images, and readable by others.

A run copies files into the output folder after a stage has returned, so no stage can leave half of its files there.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree

import numpy as np

from pano_mvs.core.paths import below, children, stat_of
from pano_mvs.engine.stages.stage import Cardinality, Names, StageSpec
from pano_mvs.scene import Files, PointCloud, Poses
from pano_mvs.scene.photographs import Photographs
from pano_mvs.scene.pose_groups import join_groups, with_cameras
from pano_mvs.scene.surfaces import Structure, TrackedPoints
from pano_mvs.testing.stage_calls import Call, StageCase


def exporter_tests(spec: StageSpec) -> dict[str, Callable[[StageCase], None]]:
    """Return the contract tests of a stage that returns files, by name; none for other stages."""
    tests: dict[str, Callable[[StageCase], None]] = {}
    if issubclass(spec.output, Files):
        tests["writes to its scratch folder only"] = _writes_to_scratch
    if not tests or any(port.cardinality is Cardinality.EACH for port in spec.ports):
        return tests
    tests["accepts images of any name"] = _accepts_any_name
    if any(port.kind in (Poses, PointCloud) for port in spec.ports):
        tests["states the frame of its coordinates"] = _states_frame
        tests["leaves out images without a pose"] = _leaves_out_unregistered
        if all(port.optional for port in spec.ports if port.kind in _OF_ONE_GROUP):
            tests["keeps groups of poses apart"] = _keeps_groups_apart
    return tests


_OF_ONE_GROUP = (Photographs, Structure, TrackedPoints)
# Characters with a meaning in XML, HTML, JSON, URLs or shells, as far as the system allows them in names of files;
# blanks; a letter outside ASCII; a folder.
_ODD_NAME = "ä b/#{} 'x' & $0%20.png" if os.name == "nt" else 'ä b/#{} "x" & <i>$0%20.png'
_PARSERS: Mapping[str, Callable[[bytes], object]] = {
    ".json": json.loads,
    ".xml": ElementTree.fromstring,
    ".svg": ElementTree.fromstring,
}
# Formats of files that may be about several groups or state names of other files.
_TEXTS = (*_PARSERS, ".cfg", ".html", ".js", ".mtl", ".obj")


def _writes_to_scratch(case: StageCase) -> None:
    """The stage changes nothing beside its inputs or in the current folder."""

    def times() -> dict[Path, int]:
        return {path: found.st_mtime_ns for path in below(case.capture.folder) if (found := stat_of(path))}

    before = times()
    with TemporaryDirectory() as current, chdir(current):
        case.call(case.capture)
        changed = children(Path(current))
    changed += [path for path, at in times().items() if at != before.get(path)]
    assert not changed, f"{case.spec.name} writes {', '.join(map(str, changed))}, outside ctx.scratch"


def _accepts_any_name(case: StageCase) -> None:
    """The stage writes as many files whatever images are called, and others can parse them."""
    names = {name: _ODD_NAME.format(idx) for idx, name in enumerate(case.capture.names)}
    plain, odd = _call(case, lambda value: value).files, _call(case, partial(_renamed, names)).files
    assert len(odd) == len(plain), f"{case.spec.name} writes {len(odd)} files, not {len(plain)}, if names are odd"
    for target, content in odd.items():
        _PARSERS.get(PurePosixPath(target).suffix, len)(content)


def _states_frame(case: StageCase) -> None:
    """The description of the stage or of a setting says in which frame coordinates are."""
    settings = case.spec.params_type.model_fields.values()
    text = " ".join([case.spec.doc, *(str(info.description) for info in settings)])
    stated = any(word in text for word in ("world", "z up", "COLMAP", "level"))
    assert stated, f"the description of {case.spec.name} does not say in which frame the coordinates are"


def _leaves_out_unregistered(case: StageCase) -> None:
    """The files do not depend on images without a pose."""
    registered = partial(_of_images, case.capture.names[:-1])
    beside = _call(case, lambda value: registered(value) if isinstance(value, Poses) else value)
    assert beside.files == _call(case, registered).files, f"{case.spec.name} depends on images without a pose"


def _keeps_groups_apart(case: StageCase) -> None:
    """Each group of poses has the same files as when it is alone, unless a note says why not; texts may be of all."""
    halves = [partial(_of_images, part) for part in (case.capture.names[:2], case.capture.names[2:])]

    def joined(value: Any) -> Any:
        if isinstance(value, Poses):
            return join_groups([half(value) for half in halves])
        return PointCloud.of_groups([value, value]) if isinstance(value, PointCloud) else value

    first, second, both = (
        _call(case, lambda value, change=change: None if isinstance(value, _OF_ONE_GROUP) else change(value))  # type: ignore[misc]
        for change in (*halves, joined)
    )
    one, other, found = (
        {target: data for target, data in call.files.items() if PurePosixPath(target).suffix not in _TEXTS}
        for call in (first, second, both)
    )
    lost = [target for target, data in one.items() if found.get(target) != data]
    assert not lost, f"{case.spec.name}: a second group of poses changes {', '.join(lost)} of the first"
    missing = Counter(other.values()) - (Counter(found.values()) - Counter(one.values()))
    assert not missing or any("group 1" in note for note in both.notes), (
        f"{case.spec.name} does not write {missing.total()} files of the second group of poses, and has no note"
    )


def _call(case: StageCase, change: Callable[[Any], Any]) -> Call:
    """Call the stage with each input changed."""
    given = case.arguments(case.capture)
    return case.call(case.capture, arguments={port: change(value) for port, value in given.items()})


def _of_images(names: Sequence[str], value: Any) -> Any:
    """Return an input as if the capture had only some of its images."""
    if isinstance(value, Poses):
        return with_cameras(value, np.isin(value.names, names))
    if isinstance(value, Names):
        return Names(names)
    return {name: value[name] for name in names} if isinstance(value, Mapping) else value


def _renamed(names: Mapping[str, str], value: Any) -> Any:
    if isinstance(value, Poses | TrackedPoints):
        return replace(value, names=tuple(names[name] for name in value.names))
    if isinstance(value, Names):
        return Names(names.values())
    return {names[name]: item for name, item in value.items()} if isinstance(value, Mapping) else value
