"""Readers of plugins: files of poses and captures of other kinds, before the built-in ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import pano_mvs
from pano_mvs.core.errors import InputError, PluginError
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.io.poses.files import match_images, read_groups, read_poses
from pano_mvs.io.readers import CAPTURE_READERS, POSE_READERS, capture_reader_of, pose_reader_of
from pano_mvs.session.session import open_session
from pano_mvs.testing.tiny_capture import Variant, tiny_capture
from tests.plugin_packages import Packages

LOG = '''\
import numpy as np

from pano_mvs.api import InputError, Rigid3
from pano_mvs.io.readers import PosesRead, register_pose_reader


def is_log(path):
    with path.open("rb") as stream:
        return stream.read(6) == b"WALK 1"


@register_pose_reader("walk", what="the log of a walk", recognises=is_log)
def read_log(path):
    """Read lines of a name and a position; an empty line begins another group."""
    groups = [{}]
    for number, line in enumerate(path.read_text().splitlines()[1:], 2):
        if not line:
            groups.append({})
            continue
        name, *place = line.split()
        if len(place) != 3:
            raise InputError(f"{path}:{number}: must be a name and three numbers")
        groups[-1][name] = Rigid3.from_center(np.eye(3), [float(x) for x in place])
    return PosesRead([group for group in groups if group], {"sky.jpg": "a drone made it"}, metric=True)
'''
WALK = "WALK 1\n000.png 0 0 0\n001.png 1 0 0\n002.png 2 0 0.5\n\nattic.png 0 0 0\n"
WORKFLOW = """\
pano_mvs: 1
name: known
stages:
  images: {{use: source.folder, path: {images}}}
  poses:  {{use: poses.from_model, path: walk.{suffix}}}
"""


@pytest.fixture
def log(mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A log of a walk, in the current folder, with a plugin that reads it."""
    (mine / "walk.py").write_text(LOG)
    Registry.installed()
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "walk.log"
    path.write_text(WALK)
    return path


def test_a_plugin_reads_a_file_of_poses(log: Path) -> None:
    largest, attic = read_groups(log)
    assert largest.names == ("000.png", "001.png", "002.png")
    assert attic.names == ("attic.png",)
    np.testing.assert_allclose(largest.centers[2], [2, 0, 0.5])
    assert largest.metric
    assert dict(largest.rejected) == {"sky.jpg": "a drone made it"}


@pytest.mark.parametrize("suffix", ["log", "txt", "csv", "json"])
def test_poses_from_model_uses_the_plugin_whatever_the_suffix(log: Path, suffix: str) -> None:
    """Names in a .txt were times of a trajectory, also if a plugin had read them."""
    log.rename(log.with_suffix(f".{suffix}"))
    images = tiny_capture(Variant((32, 64))).folder / "images"
    Path("known.yaml").write_text(WORKFLOW.format(images=images, suffix=suffix))
    run = pano_mvs.run("known.yaml", executor="serial")
    assert run.summary.poses is not None
    assert run.summary.poses.registered == ("000.png", "001.png", "002.png")
    assert run.summary.exit_code == 3  # of four images
    assert match_images(["000.png"], ["000.png"], log.with_suffix(f".{suffix}")) == ({"000.png": "000.png"}, "")


def test_the_code_of_a_reader_is_in_the_cache_key(log: Path, mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses that an earlier version of a reader had read stayed in the cache."""
    images = tiny_capture(Variant((32, 64))).folder / "images"
    Path("known.yaml").write_text(WORKFLOW.format(images=images, suffix="log"))

    def computed() -> list[int]:
        return [stage.run for stage in pano_mvs.run("known.yaml", executor="serial").summary.stages]

    assert computed() == [4, 1]
    assert computed() == [0, 0]
    (mine / "walk.py").write_text("# a comment\n" + LOG)
    assert computed() == [0, 0]
    (mine / "walk.py").write_text(LOG.replace("np.eye(3), [float(x)", "np.eye(3), [2 * float(x)"))
    assert computed() == [0, 1]
    monkeypatch.setattr(POSE_READERS, "_added", {})
    (mine / "walk.py").unlink()
    run = pano_mvs.run("known.yaml", executor="serial")
    assert "poses are read from a COLMAP model" in run.summary.failures[0].cause


def test_errors_of_a_reader_name_the_file(log: Path) -> None:
    log.write_text("WALK 1\n000.png 1\n")
    with pytest.raises(InputError, match=r"walk\.log:2: must be a name and three numbers"):
        read_poses(log)
    log.write_text("WALK 1\n000.png 1 2 x\n")
    with pytest.raises(PluginError, match=r"walk\.log: the plugin that reads the log of a walk failed: ValueError"):
        read_poses(log)
    log.write_text("WALK 1\n")
    with pytest.raises(InputError, match=r"walk\.log: the log of a walk, but it holds no poses"):
        read_poses(log)


def test_other_files_are_read_as_before(log: Path, tmp_path: Path) -> None:
    path = tmp_path / "poses.json"
    view = {"image": "a.jpg", "R": np.eye(3).tolist(), "t": [0, 0, 0]}
    path.write_text(json.dumps({"metric": True, "views": [view]}))
    assert pose_reader_of(path) is None
    assert read_poses(path).names == ("a.jpg",)


def test_a_reader_that_fails_to_look_is_named(log: Path, mine: Path) -> None:
    (mine / "walk.py").write_text(LOG.replace('b"WALK 1"', "1 / 0"))
    Registry.installed()
    with pytest.raises(
        PluginError, match=r"walk\.log: the pose reader 'walk' \(.*walk\.py\) failed to look at it: Zero"
    ):
        read_poses(log)


def test_readers_that_cannot_be_used_are_passed_over(log: Path, mine: Path, packages: Packages) -> None:
    packages.add(
        "dark",
        {"pose_readers": {"a": "dark:reader", "b": "json:dumps"}, "capture_readers": {"a": "dark:reader"}},
        dark="1 / 0\n",
    )
    (mine / "walk.py").write_text(LOG)
    Registry.installed()
    assert POSE_READERS.names() == ("a", "b", "walk")
    assert len(read_poses(log).names) == 3
    assert capture_reader_of(log) is None
    (mine / "same.py").write_text(LOG.replace("def read_log", "def read"))
    Registry.installed()
    assert pose_reader_of(log) is None  # which of the two would read it?
    assert "defined twice" in POSE_READERS.problem("walk")


ALBUM = '''\
from pano_mvs.api import Panorama, Params, SourceItem, SourcePath, decode_image, source
from pano_mvs.io.readers import register_capture_reader


class AlbumParams(Params):
    path: SourcePath
    nadir_deg: float = 0.0
    zip: bool = False


def list_items(params):
    for line in (params.path / "album.txt").read_text().split():
        yield SourceItem(line, {"image": params.path / line})


@source("source.album", list_items=list_items)
def album(item: SourceItem, params: AlbumParams) -> Panorama:
    """Read an album."""
    image = item.file("image")
    height, width = decode_image(image.path, image.read_bytes()).shape[:2]
    return Panorama(image=image, size_hw=(height, width), source_size_hw=(height, width), nadir_deg=params.nadir_deg)


@register_capture_reader("album", what="an album", source="source.album", advice="")
def is_album(path):
    return (path / "album.txt").is_file() or path.suffix == ".album"
'''
LOOK = "pano_mvs: 1\nname: look\nstages: {images: {use: source.folder, path: photos, nadir_deg: 12}}\n"


@pytest.fixture
def album(mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An album of two images, in the current folder, with a plugin that reads it."""
    (mine / "album.py").write_text(ALBUM)
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "pictures"
    folder.mkdir()
    for name in ("000.png", "002.png"):
        (folder / name).write_bytes((tiny_capture(Variant((32, 64))).folder / "images" / name).read_bytes())
    (folder / "other.png").write_bytes((folder / "000.png").read_bytes())
    (folder / "album.txt").write_text("000.png 002.png")
    Path("look.yaml").write_text(LOOK)
    return folder


def test_a_capture_reader_replaces_the_source(album: Path) -> None:
    session = open_session("look.yaml", images=album)
    entry = session.workflow.stages["images"]
    assert entry.spec.name == "source.album"
    assert entry.params.model_dump() == {"path": album, "nadir_deg": 12.0, "zip": False}
    run = pano_mvs.run("look.yaml", images=album, executor="serial")
    assert run.summary.stages[0].units == 2


def test_a_source_that_the_user_names_is_not_replaced(album: Path) -> None:
    session = open_session("look.yaml", images=album, overrides=["images.use=source.folder"])
    assert session.workflow.stages["images"].spec.name == "source.folder"
    (album / "album.txt").unlink()
    session = open_session("look.yaml", images=album)
    assert session.workflow.stages["images"].spec.name == "source.folder"


def test_a_capture_reader_with_advice_leaves_the_workflow_as_it_is(album: Path, mine: Path) -> None:
    """A folder could be a capture of images as well; a file could not."""
    (mine / "album.py").write_text(ALBUM.replace('advice=""', 'advice="Use the workflow albums.yaml"'))
    assert open_session("look.yaml", images=album).workflow.stages["images"].spec.name == "source.folder"
    file = album / "x.album"
    file.write_text("")
    with pytest.raises(InputError, match=r"x\.album: this is an album\. Use the workflow albums\.yaml"):
        open_session("look.yaml", images=file)
    overrides = ["images.use=source.album", "images.nadir_deg=0"]
    assert open_session("look.yaml", images=file, overrides=overrides).workflow.stages["images"].params is not None


def test_a_file_that_nobody_reads_is_refused(album: Path) -> None:
    file = album / "x.scrapbook"
    file.write_text("")
    with pytest.raises(InputError, match="this is a file; give the folder that contains the images"):
        open_session("look.yaml", images=file)


def test_capture_readers_of_plugins_are_known_by_name(album: Path) -> None:
    Registry.installed()
    assert "album" in CAPTURE_READERS.names()
    found = capture_reader_of(album)
    assert found is not None
    assert found.what == "an album"
