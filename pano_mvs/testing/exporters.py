"""The part of the contract that stages which return files keep: where, of which images, and readable by others.

A run copies files into the output folder after a stage has returned, so no stage can leave half of its files there.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir
from dataclasses import replace
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree

import numpy as np

from pano_mvs.core.digest import digest_from_file
from pano_mvs.engine.stages.stage import Cardinality, Names, StageSpec
from pano_mvs.scene import Files, PointCloud, Poses
from pano_mvs.scene.photographs import Photographs
from pano_mvs.scene.pose_groups import join_groups, with_cameras
from pano_mvs.scene.surfaces import Structure, TrackedPoints
from pano_mvs.testing.stage_calls import StageCase


def exporter_tests(spec: StageSpec) -> dict[str, Callable[[StageCase], None]]:
    """Return the contract tests of a stage that returns files, by name; none for other stages."""
    if not issubclass(spec.output, Files):
        return {}
    tests: dict[str, Callable[[StageCase], None]] = {"writes to its scratch folder only": _writes_to_scratch}
    if any(port.cardinality is Cardinality.EACH for port in spec.ports):
        return tests
    tests["accepts images of any name"] = _accepts_any_name
    if any(port.kind in (Poses, PointCloud) for port in spec.ports):
        tests["states the frame of its coordinates"] = _states_frame
        tests["leaves out images without a pose"] = _leaves_out_unregistered
        if all(port.optional for port in spec.ports if port.kind in _OF_ONE_GROUP):
            tests["keeps groups of poses apart"] = _keeps_groups_apart
    return tests


_OF_ONE_GROUP = (Photographs, Structure, TrackedPoints)
# Characters with a meaning in XML, HTML, JSON, URLs or shells; blanks; a letter outside ASCII; a folder.
_ODD_NAME = 'ä b/#{} "x" & <i>$0%20.png'
_PARSERS: Mapping[str, Callable[[str], object]] = {
    ".json": json.loads,
    ".xml": ElementTree.fromstring,
    ".svg": ElementTree.fromstring,
}
# Formats of files that may be about several groups or state names of other files.
_TEXTS = (*_PARSERS, ".cfg", ".html", ".js", ".mtl", ".obj")


def _writes_to_scratch(case: StageCase) -> None:
    """The stage changes nothing beside its inputs or in the current folder."""
    capture = case.capture.folder
    before = {path: path.stat().st_mtime_ns for path in capture.rglob("*")}
    with TemporaryDirectory() as current, chdir(current):
        case.call(case.capture)
        left = [path.name for path in Path(current).iterdir()]
    changed = [str(path) for path in capture.rglob("*") if path.stat().st_mtime_ns != before.get(path)]
    assert not left + changed, f"{case.spec.name} writes {', '.join(left + changed)}, outside ctx.scratch"


def _accepts_any_name(case: StageCase) -> None:
    """The stage writes as many files whatever images are called, and others can parse them."""
    renamed = {name: _ODD_NAME.format(idx) for idx, name in enumerate(case.capture.names)}
    given = case.arguments(case.capture)
    plain, _ = _written(case, given)
    odd, _ = _written(case, {port: _renamed(value, renamed) for port, value in given.items()})
    assert len(odd) == len(plain), f"{case.spec.name} writes {len(odd)} files, not {len(plain)}, if names are odd"


def _states_frame(case: StageCase) -> None:
    """The description of the stage or of a setting says in which frame coordinates are."""
    settings = case.spec.params_type.model_fields.values()
    text = " ".join([case.spec.doc, *(str(info.description) for info in settings)])
    stated = any(word in text for word in ("world", "z up", "COLMAP", "level"))
    assert stated, f"the description of {case.spec.name} does not say in which frame the coordinates are"


def _leaves_out_unregistered(case: StageCase) -> None:
    """The files do not depend on images without a pose."""
    given, names = case.arguments(case.capture), case.capture.names[:-1]
    with_others, _ = _written(
        case,
        {
            port: _of_images(value, names) if isinstance(value, Poses | TrackedPoints) else value
            for port, value in given.items()
        },
    )
    alone, _ = _written(case, {port: _of_images(value, names) for port, value in given.items()})
    assert with_others == alone, f"{case.spec.name} depends on images without a pose"


def _keeps_groups_apart(case: StageCase) -> None:
    """Each group of poses has the same files as when it is alone, unless a note says why not; texts may be of all."""
    given = {
        port: None if isinstance(value, _OF_ONE_GROUP) else value
        for port, value in case.arguments(case.capture).items()
    }
    names = case.capture.names
    halves = [{port: _of_images(value, part) for port, value in given.items()} for part in (names[:2], names[2:])]
    joined, notes = _written(case, {port: _joined([half[port] for half in halves], given[port]) for port in given})
    first, second = (_binary(_written(case, half)[0]) for half in halves)
    lost = [target for target, digest in first.items() if joined.get(target) != digest]
    assert not lost, f"{case.spec.name}: a second group of poses changes {', '.join(lost)} of the first"
    missing = Counter(second.values()) - (Counter(_binary(joined).values()) - Counter(first.values()))
    assert not missing or any("group 1" in note for note in notes), (
        f"{case.spec.name} does not write {missing.total()} files of the second group of poses, and has no note"
    )


def _binary(digests: Mapping[str, str]) -> dict[str, str]:
    return {target: digest for target, digest in digests.items() if PurePosixPath(target).suffix not in _TEXTS}


def _written(case: StageCase, arguments: Mapping[str, Any]) -> tuple[dict[str, str], tuple[str, ...]]:
    """Call the stage; return the digest of each file by target, and the notes. Documents that can be parsed are."""
    digests: dict[str, str] = {}

    def see(value: Files) -> None:
        for target, path in value.files.items():
            digests[target] = digest_from_file(path)
            if (parser := _PARSERS.get(PurePosixPath(target).suffix)) is not None:
                parser(path.read_text(encoding="utf-8"))

    call = case.call(case.capture, arguments=arguments, see=see)
    return digests, call.notes


def _of_images(value: Any, names: Sequence[str]) -> Any:
    """Return an input as if the capture had only some of its images."""
    if isinstance(value, Poses):
        return with_cameras(value, np.isin(value.names, names))
    if isinstance(value, TrackedPoints):
        kept = np.isin(value.names, names)
        seen = kept[value.track_image_idx]
        return replace(
            value,
            names=tuple(names),
            track_point_idx=value.track_point_idx[seen],
            track_image_idx=(np.cumsum(kept, dtype=np.int32) - 1)[value.track_image_idx[seen]],
            track_bearings=value.track_bearings[seen],
        )
    if isinstance(value, Names):
        return Names(names)
    return {name: value[name] for name in names} if isinstance(value, Mapping) else value


def _joined(halves: Sequence[Any], whole: Any) -> Any:
    if isinstance(whole, Poses):
        return join_groups(halves)
    return PointCloud.of_groups(halves) if isinstance(whole, PointCloud) else whole


def _renamed(value: Any, renamed: Mapping[str, str]) -> Any:
    if isinstance(value, Poses | TrackedPoints):
        return replace(value, names=tuple(renamed[name] for name in value.names))
    if isinstance(value, Names):
        return Names(renamed[name] for name in value)
    return {renamed[name]: item for name, item in value.items()} if isinstance(value, Mapping) else value
