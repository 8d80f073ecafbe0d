"""Hostile outputs of runs are refused by name, or the page opens without errors and shows their texts as texts."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from box_run import NAMES, box_mesh, box_run
from pano_mvs_page.scene_parts import ShareOptions
from pano_mvs_page.share import share_run
from pano_mvs_viewer.shown_scene import open_scene

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3
from pano_mvs.io.colmap.writer import write_colmap_model
from pano_mvs.io.meshes import TexturedArrays, encoded_texture, write_glb
from pano_mvs.io.ply import write_ply, write_ply_mesh
from pano_mvs.io.ranges import write_range_tiff
from pano_mvs.results.run_output import load
from pano_mvs.scene.image_file import write_png
from tests.browsers.browser import Browser, open_browser
from tests.hostile_names import contents
from tests.synthetic.viewed_scenes import SIZE_HW, box_cloud

pytestmark = pytest.mark.browser

MARKUP = (
    "<img src=x onerror='window.hacked=1'>.png",
    "</script><script>window.hacked=1</script>.png",
    "\"'`;window.hacked=1;`'\".png",
    "${window.hacked=1}{{7*7}}.png",
    "--><svg onload=window.hacked=1>.png",
    "&lt;b&gt;\u2028\u202etxt\U0001f600.png",
)


def rename(folder: Path, name: str) -> None:
    """Give the first image of a run another name."""
    out = folder / "out"
    poses = load(out).poses
    assert poses is not None
    write_colmap_model(
        out / "colmap/sparse/0",
        renamed := replace(poses, names=(name, *NAMES[1:])),
        dict.fromkeys(renamed.names, SIZE_HW),
    )
    summary = json.loads((out / "run.json").read_text())
    summary["views"][0]["name"] = name
    (out / "run.json").write_text(json.dumps(summary))
    (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / "images" / NAMES[0]).rename(folder / "images" / name)


def move(folder: Path, distance: float) -> None:
    """Move the first camera far away, or all to one place."""
    poses = load(folder / "out").poses
    assert poses is not None
    cameras = {
        name: Rigid3.from_center(pose.rotation, pose.center * (number == 0 or distance == 0) * distance + 0.1)
        for number, (name, pose) in enumerate(poses.cameras.items())
    }
    moved = type(poses).without_points(cameras, frame="box", scale="metres", metric=True)
    write_colmap_model(folder / "out/colmap/sparse/0", moved, dict.fromkeys(NAMES, SIZE_HW))


def cloud(folder: Path, count: int, value: float | None = None) -> None:
    """Replace the cloud by one of so many points, every second one at a place that is none."""
    points = box_cloud(count, quality=True)
    if value is not None:
        points.points_in_world[::2] = value
    write_ply(folder / "out/cloud.ply", points, quality=True)


def mesh(folder: Path, value: float) -> None:
    vertices, colors, faces = box_mesh()
    vertices[::3] = value
    write_ply_mesh(folder / "out/mesh.ply", (vertices, colors, faces))


def glb(folder: Path, change: Callable[[bytes], bytes]) -> None:
    vertices, _, faces = box_mesh()
    texture = np.full((8, 8, 3), 99, np.uint8)
    arrays = TexturedArrays(vertices, np.zeros((len(vertices), 2), np.float32), faces)
    path = folder / "out/mesh_textured.glb"
    write_glb(path, arrays, encoded_texture(texture, "png", quality=90), form="png")
    path.write_bytes(change(path.read_bytes()))


def ranges(folder: Path, value: float) -> None:
    for name in NAMES:
        write_range_tiff(folder / "out/range" / Path(name).with_suffix(".tiff"), np.full((64, 128), value, np.float32))


def summary(folder: Path, text: str) -> None:
    """Put a text where a run.json has texts."""
    path = folder / "out/run.json"
    value = json.loads(path.read_text())
    value["workflow"] = {"name": text, "path": text}
    value["poses"] |= {"frame": text, "scale": text}
    value["rejected"] = value["doubts"] = {text: text}
    value["notes"] = value["warnings"] = [text]
    value["stopped"], value["version"] = text, text
    path.write_text(json.dumps(value))


HOSTILE: dict[str, Callable[[Path], object]] = {
    **{f"name {name}": lambda folder, name=name: rename(folder, name) for name in MARKUP},  # type: ignore[misc]
    "summary of markup": lambda folder: summary(folder, MARKUP[0] + MARKUP[1]),
    "cloud with NaN": lambda folder: cloud(folder, 3000, np.nan),
    "cloud at 1e38": lambda folder: cloud(folder, 3000, 1e38),
    "empty cloud": lambda folder: cloud(folder, 0),
    "one point": lambda folder: cloud(folder, 1),
    "mesh with NaN": lambda folder: mesh(folder, np.nan),
    "mesh at infinity": lambda folder: mesh(folder, np.inf),
    "half a GLB": lambda folder: glb(folder, lambda data: data[: len(data) // 2]),
    "GLB of many points": lambda folder: glb(folder, lambda data: data.replace(b'"count":', b'"count":9999999', 1)),
    "GLB of any lengths": lambda folder: glb(
        folder, lambda data: data[:8] + struct.pack("<II", 2**32 - 1, 2**31) + data[16:]
    ),
    "one pixel": lambda folder: write_png(folder / "images" / NAMES[0], np.zeros((1, 2, 3), np.uint8)),
    "damaged picture": lambda folder: (folder / "images" / NAMES[0]).write_bytes(b"\x89PNG\r\n\x1a\n"),
    "no pictures": lambda folder: shutil.rmtree(folder / "images"),
    "ranges of NaN": lambda folder: ranges(folder, np.nan),
    "ranges of 1e38": lambda folder: ranges(folder, 1e38),
    "cut range": lambda folder: (folder / "out/range" / NAMES[0]).with_suffix(".tiff").write_bytes(b"II*\0"),
    "a camera far away": lambda folder: move(folder, 1e15),
    "all cameras at one place": lambda folder: move(folder, 0.0),
}


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with open_browser("chromium") as window:
        window.resize(400, 300)
        yield window


@pytest.mark.parametrize("what", [*HOSTILE, "title of markup"])
def test_hostile_outputs_are_refused_or_shown(browser: Browser, tmp_path: Path, what: str) -> None:
    folder = tmp_path / "run"
    box_run(folder, points=3000, mesh=True)
    if what in HOSTILE:
        HOSTILE[what](folder)
    before = contents(tmp_path)
    title = MARKUP[1] * 3 if what == "title of markup" else ""
    try:
        page = share_run(load(folder / "out"), tmp_path / "page", ShareOptions(title=title)).page
    except InputError as error:
        assert str(folder) in str(error)  # noqa: PT017
        assert len(str(error)) < 2000  # noqa: PT017
        page = None
    assert {
        path: data for path, data in contents(tmp_path).items() if not path.startswith(f"{tmp_path}/page")
    } == before
    try:
        open_scene(folder / "out")
    except InputError as error:
        assert str(folder) in str(error)  # noqa: PT017
    # Only texts are written into the single file in a way of their own.
    names = ("index.html", "page.html") if "markup" in what or what.startswith("name") else ("index.html",)
    for name in names if page is not None else ():
        assert page is not None
        browser.open("about:blank")
        browser.open(page.with_name(name).as_uri())
        browser.wait("typeof PanoMvs === 'object' && PanoMvs.page && PanoMvs.page.settled")
        if browser.evaluate("PanoMvs.page.panoramas.length"):
            browser.evaluate("PanoMvs.page.stepInside(PanoMvs.page.panoramas[0], true)")
            browser.wait("PanoMvs.page.settled")
        assert browser.console() == []
        assert browser.evaluate("[typeof window.hacked, document.querySelectorAll('[onerror], [onload]').length]") == [
            "undefined",
            0,
        ]
