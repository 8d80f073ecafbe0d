"""The contract of readers that plugins bring: of files of poses, and of captures.

A reader must
  * look at any file or folder without raising an error: empty, binary, with a line of megabytes, or not permitted;
  * name a stage that exists and lists a path, if it reads captures;
  * read poses with rotations and finite positions, or raise InputError that names the file, also if it is damaged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.geometry import Rigid3
from pano_mvs.io.readers import CAPTURE_READERS, POSE_READERS, CaptureReader, PoseReader, PosesRead
from pano_mvs.testing.contract import ContractTest, registered_names

_NAMES = ("poses.txt", "poses.csv", "poses.json", "poses.xml", "poses.log", "poses", "photos.jpg", "walk.mp4")
_CONTENTS: dict[str, bytes] = {
    "an empty file": b"",
    "a binary file": np.random.default_rng(0).bytes(5_000),
    "null bytes": bytes(5_000),
    "a line of 4 MB": b"x" * 4_000_000,
    "empty lines": b"\n" * 5_000,
    "text of another encoding": "höhe,straße\n".encode("latin-1"),
    "a JSON value": b"[null]",
    "XML": b'<?xml version="1.0"?><a/>',
}


def reader_contract_tests(reader: Path | str, *, example: str | bytes | None = None) -> list[ContractTest]:
    """Return the contract tests of a pose reader or capture reader, given by name, or of all readers of a plugin file.

    Args:
        example: content of a file of poses that the reader reads; without it, only hostile files are read.

    Raises:
        UsageError: if the file registers no reader, or there is no reader with this name.
        PluginError: if the file cannot be loaded.
    """
    kinds = ("pose reader", "capture reader")
    names: dict[str, list[str]] = {}
    for kind, check in zip(kinds, (POSE_READERS.check, CAPTURE_READERS.check), strict=True):
        try:
            names[kind] = [check(name) for name in registered_names(kind, reader)]
        except UsageError:
            continue
    if not names:
        raise UsageError(f"{reader}: there is no such reader, or the file registers none")
    registry = Registry.installed()
    if isinstance(reader, Path):
        registry.add_file(reader)
    text = example.encode() if isinstance(example, str) else example
    return [
        *(found for name in names.get("pose reader", []) for found in _pose_tests(name, text)),
        *(found for name in names.get("capture reader", []) for found in _capture_tests(name, registry)),
    ]


def _pose_tests(name: str, example: bytes | None) -> Iterator[ContractTest]:
    reader = POSE_READERS.get(name)
    for what, content in _CONTENTS.items():
        yield ContractTest(f"{name} reads or rejects {what}", partial(_survives, reader, content))
    yield ContractTest(f"{name} recognises no folder", partial(_looks_at_folders, reader.recognises, may_be_one=False))
    yield ContractTest(f"{name} looks at files that cannot be read", partial(_looks_at_denied, reader.recognises))
    if example is not None:
        yield ContractTest(f"{name} reads its example", partial(_reads, reader, example))
        yield ContractTest(f"{name} reads or rejects damaged examples", partial(_reads_damaged, reader, example))


def _capture_tests(name: str, registry: Registry) -> Iterator[ContractTest]:
    reader = CAPTURE_READERS.get(name)
    yield ContractTest(f"{name} names its stage", partial(_names_stage, reader, registry))
    for what, content in _CONTENTS.items():
        yield ContractTest(f"{name} looks at {what}", partial(_looks, reader.recognises, content))
    yield ContractTest(f"{name} looks at folders", partial(_looks_at_folders, reader.recognises, may_be_one=True))
    yield ContractTest(f"{name} looks at files that cannot be read", partial(_looks_at_denied, reader.recognises))


def _recognised(recognises: Callable[[Path], bool], path: Path) -> bool:
    found = recognises(path)
    assert isinstance(found, bool), f"`recognises` returns {found!r} for {path.name}, neither True nor False"
    return found


def _looks(recognises: Callable[[Path], bool], content: bytes) -> None:
    with TemporaryDirectory() as folder:
        for name in _NAMES:
            path = Path(folder) / name
            path.write_bytes(content)
            _recognised(recognises, path)


def _looks_at_folders(recognises: Callable[[Path], bool], *, may_be_one: bool) -> None:
    with TemporaryDirectory() as folder:
        for name in ("empty", *_NAMES):
            path = Path(folder) / name
            path.mkdir()
            if name != "empty":
                (path / "a.txt").write_bytes(b"")
            assert not _recognised(recognises, path) or may_be_one, f"a folder is taken for a file of poses: {name}"


def _looks_at_denied(recognises: Callable[[Path], bool]) -> None:
    with TemporaryDirectory() as folder:
        for name in _NAMES:
            path = Path(folder) / name
            path.write_bytes(b"")
            path.chmod(0)  # without effect for an administrator, who can read it
            _recognised(recognises, path)
            path.unlink()
            _recognised(recognises, path)  # it was removed a moment ago


def _survives(reader: PoseReader, content: bytes) -> None:
    with TemporaryDirectory() as folder:
        for name in _NAMES:
            path = Path(folder) / name
            path.write_bytes(content)
            if _recognised(reader.recognises, path):
                _read(reader, path)


def _read(reader: PoseReader, path: Path) -> PosesRead | None:
    """Return the poses in a file; None if the reader rejects it as it should.

    Raises:
        AssertionError: if they are not poses, or the error does not name the file.
    """
    try:
        found = reader.read(path)
    except InputError as error:
        refusal = str(error)
    else:
        _check_poses(found)
        return found
    assert path.name in refusal, f"the error does not name the file {path.name}: {refusal}"
    return None


def _check_poses(found: PosesRead) -> None:
    assert isinstance(found, PosesRead), f"`read` returns {type(found).__name__}, not PosesRead"
    for group in found.groups:
        for image, pose in group.items():
            assert isinstance(image, str), f"the name of an image is {image!r}, not a text"
            assert isinstance(pose, Rigid3), f"the pose of {image} is {type(pose).__name__}, not Rigid3"
            _check_pose(image, pose)
    assert all(isinstance(reason, str) and reason for reason in found.others.values()), "others need reasons"


def _check_pose(image: str, pose: Rigid3) -> None:
    rotation, translation = np.asarray(pose.rotation, np.float64), np.asarray(pose.translation, np.float64)
    assert rotation.shape == (3, 3), f"the rotation of {image} has the shape {rotation.shape}"
    assert translation.shape == (3,), f"the translation of {image} has the shape {translation.shape}"
    assert np.isfinite(rotation).all(), f"the rotation of {image} is not finite"
    assert np.isfinite(translation).all(), f"the translation of {image} is not finite"
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-6, f"the matrix of {image} does not keep lengths"
    assert np.linalg.det(rotation) > 0, f"the matrix of {image} is a reflection, not a rotation"


def _reads(reader: PoseReader, example: bytes) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "poses.txt"
        path.write_bytes(example)
        assert _recognised(reader.recognises, path), "the example is not recognised"
        found = reader.read(path)
        assert any(found.groups), "the example holds no poses"
        _read(reader, path)


def _reads_damaged(reader: PoseReader, example: bytes) -> None:
    rng = np.random.default_rng(0)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "poses.txt"
        for number in range(60):
            place = int(rng.integers(len(example)))
            damages = (
                example[:place],
                example[:place] + example[place + 1 :],
                example[:place] + bytes(rng.integers(0, 256, 3).tolist()) + example[place + 1 :],
                example[:place] + (b"x", b"\n", b",", b" nan ", b" 1e999 ", b'"')[number % 6] + example[place:],
            )
            path.write_bytes(damages[number % 4])
            if _recognised(reader.recognises, path):
                _read(reader, path)


def _names_stage(reader: CaptureReader, registry: Registry) -> None:
    assert reader.what, "the reader does not say what it reads"
    spec = registry.stages.get(reader.source)
    assert spec is not None, f"there is no stage {reader.source!r}"
    assert spec.list_items is not None, f"{reader.source} is not a source: decorate it with @source"
    assert "path" in spec.params_type.model_fields, f"{reader.source} has no setting `path`"
