"""The folder and the file that `pano-mvs share` writes."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from box_run import NAMES, box_ranges, box_run
from pano_mvs_page.encoding import encode_ranges, panorama_tiles, tile_layout
from pano_mvs_page.page_folder import SCRIPTS
from pano_mvs_page.scene_parts import ShareOptions
from pano_mvs_page.share import page_from_world, share_run
from typer.testing import CliRunner

import pano_mvs
from pano_mvs.cli.app import app
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.results.run_output import RunOutput, load
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import FilePart, Panorama
from pano_mvs.scene.image_file import write_png
from tests.synthetic.viewed_scenes import turned_poses, world_color


def value_of(script: Path) -> Any:
    """Return the value that a data file hands to the page."""
    call = re.fullmatch(r'PanoMvs\.receive\("[^"]+", (.*)\);\n', script.read_text(), re.DOTALL)
    assert call is not None, script
    return json.loads(call[1])


def test_the_folder_has_the_cloud_the_cameras_and_the_panoramas(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    shared = share_run(box_run(tmp_path), tmp_path / "page", progress=lambda done, total: seen.append((done, total)))
    assert (shared.points, shared.panoramas, shared.notes) == (20_000, 3, ())
    assert seen == [(1, 3), (2, 3), (3, 3)]
    data = tmp_path / "page" / "data"
    scene = value_of(data / "scene.js")
    assert [camera["name"] for camera in scene["cameras"]] == list(NAMES)
    assert scene["unit"] == "m"
    assert sum(node["count"] for node in scene["nodes"]) == 20_000
    assert shared.total_bytes == sum(path.stat().st_size for path in data.rglob("*.js"))
    tile = cv2.imdecode(
        np.frombuffer(base64.b64decode(value_of(data / "panorama/1/0-0-0.js")), np.uint8), cv2.IMREAD_COLOR_RGB
    )
    assert tile is not None
    assert tile.shape == (512, 1024, 3)


def test_cameras_on_the_map_have_the_probability_of_their_poses_where_it_is_known(tmp_path: Path) -> None:
    path = box_run(tmp_path).out / "run.json"
    summary = json.loads(path.read_text())
    summary["poses"]["p_right"] = {NAMES[0]: 0.5, NAMES[1]: 0.999, NAMES[2]: None}
    path.write_text(json.dumps(summary))
    share_run(path.parent, tmp_path / "page")
    cameras = value_of(tmp_path / "page" / "data" / "scene.js")["cameras"]
    judged = [(camera.get("right"), camera.get("color")) for camera in cameras]
    assert judged == [("50 %", "#c7264a"), ("99.9 %", "#1a9973"), (None, None)]


def test_a_level_world_is_upright_though_the_cameras_were_tilted() -> None:
    tilted = [Rigid3(rotation_from_rotvec([0.3, 0.0, deg]), np.zeros(3)) for deg in (0.1, 0.2)]
    assert page_from_world(tilted, is_level=True).rotation @ [0, -1, 0] == pytest.approx([0, 1, 0], abs=1e-12)
    assert (page_from_world(tilted).rotation @ [0, -1, 0])[1] < 0.99


def test_y_is_up_in_the_page_and_cameras_keep_their_distances(tmp_path: Path) -> None:
    poses = list(turned_poses(3, level=True).values())
    frame = page_from_world(poses)
    for pose in poses:
        assert frame.rotation @ pose.rotation.T @ [0, -1, 0] == pytest.approx([0, 1, 0], abs=1e-9)
    assert frame.rotation @ poses[0].rotation.T @ [0, 0, 1] == pytest.approx([0, 0, -1], abs=1e-9)
    assert np.linalg.det(frame.rotation) == pytest.approx(1)
    share_run(box_run(tmp_path), tmp_path / "page")
    cameras = value_of(tmp_path / "page" / "data" / "scene.js")["cameras"]
    for camera, pose in zip(cameras, poses, strict=True):
        assert camera["center"] == pytest.approx(frame.apply(pose.center))
        assert np.array(camera["page_from_cam"]) == pytest.approx(frame.rotation @ pose.rotation.T)


def test_ranges_keep_four_digits_and_gaps() -> None:
    ranges = box_ranges(turned_poses(1)["lobby/000.png"], (64, 128))
    ranges[5, 7] = np.nan
    text, low, high = encode_ranges(ranges)
    steps = np.frombuffer(base64.b64decode(text), "<u2").reshape(ranges.shape)
    decoded = low * np.exp((steps - 1.0) * np.log(high / low) / 65534)
    assert steps[5, 7] == 0
    assert np.count_nonzero(steps == 0) == 1
    assert np.nanmax(np.abs(decoded / ranges - 1)[steps > 0]) < 1e-4
    assert encode_ranges(np.full((2, 4), np.nan, np.float32))[1:] == (1.0, 2.0)


@pytest.mark.slow
def test_tiles_of_all_levels_cover_the_panorama() -> None:
    image = world_color(np.random.default_rng(0).normal(size=(1024, 2048, 3)))
    tiles = list(panorama_tiles(image, *tile_layout(2048, 8192)))
    assert [tile[:3] for tile in tiles] == [(0, 0, 0), (1, 0, 0), (1, 1, 0)]
    assert tiles[0][3].shape == (512, 1024, 3)
    assert np.array_equal(np.concatenate([tile[3] for tile in tiles[1:]], axis=1), image)
    assert [tile_layout(width, 8192) for width in (512, 2048, 5376, 6720, 11_000)] == [
        (1, 1024),
        (2, 1024),
        (4, 672),
        (4, 840),
        (4, 1024),
    ]


def test_the_last_level_has_the_resolution_of_the_picture() -> None:
    """A panorama of 5376 pixels was reduced to 4096, and one of 2000 to 1024."""
    image = world_color(np.random.default_rng(0).normal(size=(1000, 2000, 3)))
    tiles = list(panorama_tiles(image, *tile_layout(2000, 8192)))
    assert np.array_equal(np.concatenate([tile[3] for tile in tiles[1:]], axis=1), image)


def test_panoramas_keep_the_resolution_of_their_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run at 512 columns made a page with panoramas of 512 columns."""
    run = box_run(tmp_path, points=100)
    picture = np.repeat(np.random.default_rng(0).integers(0, 256, (1024, 2048, 1), np.uint8), 3, axis=2)
    write_png(tmp_path / "images" / NAMES[1], picture)
    panorama = Panorama(FilePart(tmp_path / "images" / NAMES[1]), (256, 512), (1024, 2048))
    known = {NAMES[1]: panorama}
    monkeypatch.setattr(type(run.values), "panorama", lambda _, name: known.get(name))
    share_run(run, tmp_path / "page", ShareOptions(jpeg_quality=100))
    data = tmp_path / "page" / "data"
    assert [camera["width"] for camera in value_of(data / "scene.js")["cameras"]] == [1024, 2048, 1024]
    encoded = np.frombuffer(base64.b64decode(value_of(data / "panorama/1/1-1-0.js")), np.uint8)
    tile = cv2.imdecode(encoded, cv2.IMREAD_COLOR_RGB)
    assert tile is not None
    assert np.abs(tile.astype(int) - picture[:, 1024:]).mean() < 3


def test_the_single_file_refers_to_nothing_and_allows_its_own_scripts_alone(tmp_path: Path) -> None:
    shared = share_run(box_run(tmp_path, points=3_000), tmp_path / "page", ShareOptions(title="A <b> & co"))
    assert shared.single_file is not None
    text = shared.single_file.read_text()
    assert "A &lt;b&gt; &amp; co" in text
    assert " src=" not in text.partition("<script>")[0]
    scripts = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy is not None
    allowed = set(re.findall(r"'sha256-([^']+)'", policy[1]))
    for script in scripts:
        assert base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() in allowed
    assert "unsafe" not in policy[1]
    assert "http" not in policy[1]
    assert len(scripts) == len(shared_pieces(shared.page.parent)) + len(SCRIPTS)


def shared_pieces(folder: Path) -> list[Path]:
    return sorted((folder / "data").rglob("*.js"))


def test_a_large_run_has_no_single_file(tmp_path: Path) -> None:
    run = box_run(tmp_path)
    share_run(run, tmp_path / "page")
    assert (tmp_path / "page" / "page.html").exists()
    shared = share_run(run, tmp_path / "page", ShareOptions(max_points=2_000, max_single_file_bytes=1_000))
    assert shared.single_file is None
    assert not (tmp_path / "page" / "page.html").exists()
    assert shared.points == 2_000


@pytest.mark.slow
def test_a_run_is_shared_from_python_and_shown_in_a_notebook(tmp_path: Path) -> None:
    run = box_run(tmp_path)
    shared = run.share(str(tmp_path / "page"), pano_mvs.ShareOptions(title='The "lobby" & more', max_points=1000))
    assert shared.points == 1000
    (text,) = re.findall(r'^<iframe srcdoc="([^"]*)" sandbox="allow-scripts" width="100%" height="600"></iframe>$',
                         shared._repr_html_(), re.DOTALL)  # fmt: skip
    assert html.unescape(text) == (tmp_path / "page" / "page.html").read_text(encoding="utf-8")
    too_large = pano_mvs.share_run(run.out, tmp_path / "page", ShareOptions(max_single_file_bytes=1000))
    assert f"Open {tmp_path / 'page' / 'index.html'} in a browser" in too_large._repr_html_()


@pytest.mark.slow
@pytest.mark.parametrize(("folder", "title"), [("office/images", "office"), ("2024 <flat>", "2024 <flat>")])
def test_the_title_is_the_folder_of_the_capture(tmp_path: Path, folder: str, title: str) -> None:
    run = box_run(tmp_path, points=100)
    summary = json.loads((run.out / "run.json").read_text())
    summary["stages"][0]["params"]["path"] = str(tmp_path / folder)
    (run.out / "run.json").write_text(json.dumps(summary))
    page = share_run(load(run.out), tmp_path / "page", images=tmp_path / "images").page
    assert value_of(page.parent / "data" / "scene.js")["title"] == title
    assert f"<title>{html.escape(title)}</title>" in page.read_text()
    summary["stages"] = []
    (run.out / "run.json").write_text(json.dumps(summary))
    page = share_run(load(run.out), tmp_path / "page", images=tmp_path / "images").page
    assert "<title>out</title>" in page.read_text()


def test_a_folder_with_something_else_is_refused_and_kept(tmp_path: Path) -> None:
    run = box_run(tmp_path, points=100)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "index.html").write_text("mine")
    with pytest.raises(UsageError, match="not empty and holds no earlier page"):
        share_run(run, tmp_path / "mine")
    assert (tmp_path / "mine" / "index.html").read_text() == "mine"
    with pytest.raises(UsageError, match="this is a file"):
        share_run(run, tmp_path / "mine" / "index.html")


def test_a_place_below_a_file_is_a_mistake_and_no_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`share` advised to free some space, with the exit code of a full disk."""
    monkeypatch.chdir(tmp_path)
    run = box_run(tmp_path, points=200)
    Path("afile").touch()
    result = CliRunner().invoke(app, ["share", str(run.out), "--to", "afile/x"], env={"COLUMNS": "200"})
    assert result.exit_code == 2, result.output
    assert "afile/x: cannot be written (Not a directory). Give another folder" in " ".join(result.output.split())


def test_an_interrupted_page_is_written_again(tmp_path: Path) -> None:
    run = box_run(tmp_path, points=100)

    def interrupt(_done: int, _total: int) -> None:
        raise KeyboardInterrupt("by the user")

    with pytest.raises(KeyboardInterrupt, match="by the user"):
        share_run(run, tmp_path / "page", progress=interrupt)
    assert not (tmp_path / "page" / "index.html").exists()
    assert share_run(run, tmp_path / "page").panoramas == 3


@pytest.mark.slow
def test_a_panorama_that_is_gone_is_noted(tmp_path: Path) -> None:
    run = box_run(tmp_path, points=100)
    (tmp_path / "images" / NAMES[1]).unlink()
    shared = share_run(load(run.out), tmp_path / "page")
    assert shared.panoramas == 2
    assert "1 of 3 panoramas could not be read, such as lobby/001.png" in shared.notes[0]
    (tmp_path / "images").rename(tmp_path / "moved")
    assert share_run(load(run.out), tmp_path / "page").panoramas == 0
    assert share_run(load(run.out), tmp_path / "page", images=tmp_path / "moved").panoramas == 2


def test_other_images_are_not_replaced_by_those_of_the_run(tmp_path: Path) -> None:
    """Another folder that lacks the images is a mistake to be shown, not to be passed over."""
    run = box_run(tmp_path, points=100)
    (tmp_path / "others").mkdir()
    shared = share_run(load(run.out), tmp_path / "page", images=tmp_path / "others")
    assert shared.panoramas == 0
    assert "3 of 3 panoramas could not be read" in shared.notes[0]


def test_a_page_is_not_replaced_when_there_is_nothing_to_show(tmp_path: Path) -> None:
    run = box_run(tmp_path, points=100)
    page = share_run(run, tmp_path / "page").page
    before = page.read_bytes()
    without_cloud = RunOutput(tmp_path / "nowhere", run.summary, StoredValues())
    without_cloud.__dict__["poses"] = run.poses
    with pytest.raises(InputError, match="neither a cloud nor a panorama"):
        share_run(without_cloud, tmp_path / "page", images=tmp_path / "nowhere")
    assert page.read_bytes() == before


def test_an_interrupted_run_is_noted(tmp_path: Path) -> None:
    run = box_run(tmp_path, points=100)
    summary = run.summary.model_copy(update={"exit_code": 130})
    (run.out / "run.json").write_text(json.dumps(summary.to_json()))
    assert "interrupted" in " ".join(share_run(load(run.out), tmp_path / "page").notes)


def test_a_run_with_nothing_to_show_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="neither a cloud nor cameras"):
        share_run(RunOutput(tmp_path, RunSummary(), StoredValues()), tmp_path / "page")


@pytest.mark.parametrize(
    ("options", "message"),
    [({"max_points": -1}, "--points -1"), ({"max_width": 10}, "--width 10"), ({"jpeg_quality": 0}, "--quality 0")],
)
def test_options_out_of_range_are_refused(options: dict[str, int], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        ShareOptions(**options)  # type: ignore[arg-type]  # names and values as of the command line


def test_the_command_says_where_the_page_is(tmp_path: Path) -> None:
    run = box_run(tmp_path, points=1_000)
    done = CliRunner().invoke(app, ["share", str(run.out), "--to", str(tmp_path / "page"), "--title", "Lobby"])
    assert done.exit_code == 0, done.output
    assert "1,000 points and 3 panoramas" in done.output
    assert "index.html" in done.output
    assert "<title>Lobby</title>" in (tmp_path / "page" / "index.html").read_text()


def test_none_means_no_points_and_no_triangles(tmp_path: Path) -> None:
    """`--points 0` wrote all points."""
    run = box_run(tmp_path / "run", points=500, mesh=True)
    shared = share_run(run, tmp_path / "page", ShareOptions(max_points=0, max_triangles=0))
    assert (shared.points, shared.triangles, shared.panoramas) == (0, 0, 3)
