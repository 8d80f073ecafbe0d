"""Input and paths that cannot be used: each is named, with what to do."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.cli.conftest import SIZE_HW, SMALL, Command, deliverables, run_json
from tests.io.images.pictures import app1, full_sphere, xmp
from tests.permissions import permissions_hold
from tests.stored import read_picture

TO_POSES = ("--until", "poses", *SMALL)

STOPS_AFTER_FEATURES = """\
pano_mvs: 1
stages:
  images:   {{use: source.folder, path: {images}}}
  features: {{use: features.orb_tangent, max_keypoints: 200}}
"""


@pytest.fixture
def short(tmp_path: Path, capture: Path) -> Path:
    """A workflow that is over after the features."""
    path = tmp_path / "short.yaml"
    path.write_text(STOPS_AFTER_FEATURES.format(images=capture / "images"))
    return path


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ("quickstart --images empty", "no images here"),
        ("quickstart --images nowhere", "there is no such folder or video"),
        ("quickstart --images hall.jpg", "this is a file; give the folder that contains the images"),
        ("quickstart --images one", "depth needs two or more panoramas"),
        ("SHORT --images bad", "none of the 4 items can be used"),
        ("SHORT --out CAPTURE", "reads this folder"),
        ("SHORT --set images.masks=nowhere", "nowhere does not exist"),
    ],
)
def test_input_that_cannot_be_used(pano_mvs: Command, short: Path, capture: Path, options: str, what: str) -> None:
    picture = (capture / "images" / "000.png").read_bytes()
    for name, contents in {"empty": [], "one": [picture], "bad": 4 * [b"no picture"]}.items():
        Path(name).mkdir()
        for number, content in enumerate(contents):
            (Path(name) / f"{number}.png").write_bytes(content)
    Path("hall.jpg").touch()
    result = pano_mvs("run", *options.replace("SHORT", str(short)).replace("CAPTURE", str(capture / "images")).split())
    assert result.code == 2
    assert what in result.flat


@pytest.mark.slow
def test_bad_pictures_among_good_ones(pano_mvs: Command, short: Path, capture: Path) -> None:
    image = read_picture(capture / "images" / "001.png")
    (capture / "images" / "001.png").unlink()
    data = cv2.imencode(".jpg", image)[1].tobytes()
    sphere = full_sphere(*image.shape[:2], FullPanoWidthPixels=2 * 10**9, FullPanoHeightPixels=10**9)
    damaged = {
        "truncated": data[: len(data) // 2],
        "text": b"not a picture",
        "empty": b"",
        "not 2:1": cv2.imencode(".jpg", image[:, :-64])[1].tobytes(),
        "huge sphere": data[:2] + app1(b"http://ns.adobe.com/xap/1.0/\0" + xmp(sphere)) + data[2:],
    }
    for name, content in damaged.items():
        (capture / "images" / f"{name}.jpg").write_bytes(content)
    result = pano_mvs("run", short, "--out", "out")
    assert result.code == 3, result.text
    report = (Path("out") / "report.html").read_text()
    assert [name for name in damaged if f"{name}.jpg" not in result.flat or f"{name}.jpg" not in report] == []
    assert run_json(Path("out"))["stages"][1]["run"] == 3
    for name in damaged:
        (capture / "images" / f"{name}.jpg").unlink()
    cv2.imwrite(str(capture / "images" / "001.png"), image)
    again = pano_mvs("run", short, "--out", "out")
    assert again.code == 0
    assert run_json(Path("out"))["stages"][1]["cached"] == 3, "nothing that was computed is lost"


@pytest.mark.slow
def test_mixed_sizes_work(pano_mvs: Command, capture: Path) -> None:
    path = capture / "images" / "002.png"
    image = read_picture(path)
    cv2.imwrite(str(path), cv2.resize(image, (256, 128), interpolation=cv2.INTER_AREA))
    result = pano_mvs("run", "quickstart", "--images", capture / "images", "--out", "out", *TO_POSES)
    assert result.code == 0, result.text
    assert run_json(Path("out"))["poses"]["registered"] == [f"00{number}.png" for number in range(4)]


def test_of_two_identical_pictures_the_second_is_left_out(pano_mvs: Command, short: Path, capture: Path) -> None:
    shutil.copy(capture / "images" / "000.png", capture / "images" / "000_copy.png")
    result = pano_mvs("run", short, "--out", "out")
    assert result.code == 3, result.text
    assert [unit["item"] for unit in run_json(Path("out"))["failures"]] == ["000_copy.png"]


def test_output_folder_that_cannot_be_written(pano_mvs: Command, short: Path) -> None:
    Path("blocked").write_text("a file")
    result = pano_mvs("run", short, "--out", "blocked/out")
    assert result.code == 2
    assert "Choose another folder with --out DIR" in result.flat
    Path("locked").mkdir(mode=0o500)
    with permissions_hold():
        assert pano_mvs("run", short, "--out", "locked/out").code == 2


@pytest.mark.slow
def test_pictures_of_two_places_make_no_false_model(pano_mvs: Command, capture: Path) -> None:
    rng = np.random.default_rng(1)
    for name in ("002.png", "003.png"):
        noise = rng.integers(0, 255, (20, 40, 3), dtype=np.uint8)
        cv2.imwrite(str(capture / "images" / name), cv2.resize(noise, SIZE_HW[::-1], interpolation=cv2.INTER_CUBIC))
    by_sift = ("--set", "weak.learned=never")  # the networks take long to find nothing
    result = pano_mvs("run", "quickstart", "--images", capture / "images", "--out", "out", *TO_POSES, *by_sift)
    assert result.code == 3, result.text
    summary = run_json(Path("out"))
    assert summary["poses"]["registered"] == ["000.png", "001.png"]
    assert set(summary["rejected"]) == {"002.png", "003.png"}


@pytest.mark.slow
def test_outputs_are_no_pictures_of_another_run(
    pano_mvs: Command, short: Path, capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`--images .` with `out/` below it once swept up what it had written, also after an interrupted run."""
    with short.open("a") as workflow:
        workflow.write("  written: {use: export.colmap_masks, pictures: true}\n")
    monkeypatch.chdir(capture / "images")
    arguments = ("run", short, "--images", ".", "--out", "out")
    assert pano_mvs(*arguments).code == 0
    assert len(list(Path("out").rglob("*.png"))) == 8
    for name in ("", "run.json", "report.html"):
        if name:
            Path("out", name).unlink()
        assert "0 units computed" in pano_mvs(*arguments).text


@pytest.mark.skipif(os.name != "posix", reason="names of any bytes exist on POSIX systems only")
def test_names_that_cannot_be_written_or_look_like_markup(pano_mvs: Command, short: Path, capture: Path) -> None:
    images = capture / "images"
    shutil.copy(os.fsencode(images / "000.png"), os.fsencode(images) + b"/gr\xf6sse.png")
    (images / "a[").mkdir()
    (images / "a[" / "b].jpg").write_bytes(b"broken")
    result = pano_mvs("run", short, "--out", "out")
    assert result.code == 3, result.text
    assert "rename it" in result.flat
    assert "a[/b].jpg" in result.flat


def test_linked_folders_are_followed_and_loops_end(pano_mvs: Command, short: Path, capture: Path) -> None:
    (capture / "links").mkdir()
    (capture / "links" / "to").symlink_to(capture / "images", target_is_directory=True)
    (capture / "links" / "loop").symlink_to(capture / "links", target_is_directory=True)
    result = pano_mvs("run", short, "--images", capture / "links", "--out", "out")
    assert result.code == 0, result.text
    assert run_json(Path("out"))["stages"][0]["units"] == 4


def test_status_of_a_strange_run_json(pano_mvs: Command, short: Path) -> None:
    Path("out").mkdir()
    for text in ("{}", "[1]", "nonsense"):
        Path("out/run.json").write_text(text)
        result = pano_mvs("status", short, "--out", "out")
        assert result.code == 0, result.text
        assert "Run the workflow again" in result.flat


def test_pictures_without_a_mask_are_told_in_each_run_and_only_there(
    pano_mvs: Command, capture: Path, tmp_path: Path
) -> None:
    masks = tmp_path / "blinds"
    masks.mkdir()
    cv2.imwrite(str(masks / "000.png"), np.full((160, 320), 255, np.uint8))
    arguments = ["run", "quickstart", "--images", capture / "images", "--out", tmp_path / "out", "--until", "images"]
    assert "has no mask" not in pano_mvs(*arguments).text
    for _ in range(2):
        text = pano_mvs(*arguments, "--set", f"images.masks={masks}").text
        assert "001.png has no mask in blinds" in text
        assert "000.png has no mask" not in text
    assert "has no mask" not in pano_mvs(*arguments).text


@pytest.mark.slow
def test_a_picture_that_never_registers_keeps_no_files_of_renamed_pictures(pano_mvs: Command, capture: Path) -> None:
    """A capture with such a picture ends with exit code 3 each time, and kept files of renamed pictures."""
    noise = np.random.default_rng(0).integers(0, 256, (*SIZE_HW, 3)).astype(np.uint8)
    cv2.imwrite(str(capture / "images" / "999.png"), cv2.GaussianBlur(noise, (0, 0), 20))
    by_sift = ("--set", "weak.learned=never")  # the networks take long to find nothing
    left_out = [word for stage in ("previews", "cloud", "ply") for word in ("--set", f"{stage}=null")]
    command = ("run", "quickstart", "--images", capture / "images", "--out", "out", *SMALL, *by_sift, *left_out)
    assert pano_mvs(*command).code == 3
    before = deliverables(Path("out"))
    assert [name for name in before if "003" in name]
    assert not [name for name in before if name.startswith("range/999")]
    (capture / "images" / "003.png").rename(capture / "images" / "renamed.png")
    assert pano_mvs(*command).code == 3
    after = deliverables(Path("out"))
    assert not [name for name in after if "003" in name]
    assert {name.replace("renamed", "003") for name in after} == before.keys()


IMAGES_ALONE = """\
pano_mvs: 1
stages:
  images: {{use: source.folder, path: {images}}}
"""

COMMANDS = [
    "run quickstart --images PATH --out o",
    "run PATH",
    "plan quickstart --cache PATH",
    "run quickstart --cache PATH --out o",
    "run quickstart --out PATH",
    "inspect PATH 0 1 1",
    "report PATH",
    "cache verify --cache PATH",
    "check quickstart --set images.masks=PATH",
    "check known_poses --set poses.path=PATH",
]


@pytest.fixture
def alone(tmp_path: Path, capture: Path) -> Path:
    """A workflow that reads its images and does nothing else."""
    path = tmp_path / "alone.yaml"
    path.write_text(IMAGES_ALONE.format(images=capture / "images"))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("path", ["locked/in", "locked/in/a.yaml", "n" * 300, "circle/x", "a\0b"])
def test_path_that_cannot_be_looked_at_is_no_bug(pano_mvs: Command, path: str) -> None:
    """`is_file` and its like raised below folders that may not be searched, and for names that are too long."""
    Path("locked/in").mkdir(parents=True)
    Path("locked/in/a.yaml").write_text("pano_mvs: 1\n")
    Path("circle").symlink_to("circle")
    Path("locked").chmod(0)
    with permissions_hold():
        results = {command: pano_mvs(*command.replace("PATH", path).split(" ")) for command in COMMANDS}
    Path("locked").chmod(0o700)
    for command, result in results.items():
        assert result.code == 2, (command, result.text)
        assert "error" in result.text.lower(), command
        assert "Traceback" not in result.text, command


@pytest.mark.parametrize(
    "command",
    [
        *(command.replace("PATH", "{}") for command in COMMANDS if "--set" not in command),
        "run {}",
        "show {}",
        "merge o1 {} --out o",
        "plugins --plugin {}",
        "plugin new stage s --dir {}",
        "doctor --out {}",
    ],
)
def test_an_empty_path_is_refused(pano_mvs: Command, command: str) -> None:
    """A variable of the shell without a value stood for the current folder, which `run` then filled."""
    result = pano_mvs(*(word.format("") for word in command.split()))
    assert result.code == 2
    assert "the name is empty" in result.flat
    assert not any(Path().iterdir())


def test_a_place_below_a_file_is_a_mistake_and_no_full_disk(pano_mvs: Command) -> None:
    """It was advised to free some space, with the exit code of a full disk."""
    Path("afile").touch()
    for command in (
        ("show", "fast", "--out", "afile/x"),
        ("schema", "--out", "afile/x"),
        ("plugin", "new", "mask", "s", "--dir", "afile/x"),
    ):
        result = pano_mvs(*command)
        assert result.code == 2, result.text
        assert "afile/x: cannot be written (Not a directory). Give another folder" in result.flat


def test_what_is_wrong_with_a_path_is_said(pano_mvs: Command) -> None:
    Path("locked/in").mkdir(parents=True)
    Path("locked").chmod(0)
    with permissions_hold():
        assert (
            "--images locked/in: cannot be read (Permission denied)"
            in pano_mvs("run", "quickstart", "--images", "locked/in").flat
        )
        assert (
            "cache locked/in cannot be read (Permission denied)"
            in pano_mvs("plan", "quickstart", "--cache", "locked/in").flat
        )
    Path("locked").chmod(0o700)


def test_plugins_are_listed_where_the_folder_of_settings_may_not_be_searched(
    pano_mvs: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PANO_MVS_PLUGINS", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings" / "in"))
    monkeypatch.setenv("HOME", str(tmp_path / "settings"))
    (tmp_path / "settings").mkdir(mode=0)
    with permissions_hold():
        result = pano_mvs("plugins")
    assert result.code == 0, result.text


def test_cache_that_is_the_folder_of_the_images_is_refused(
    pano_mvs: Command, alone: Path, capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cache's own images were taken for panoramas on the second run."""
    for command in ("run", "plan", "status"):
        result = pano_mvs(command, alone, "--cache", capture / "images")
        assert result.code == 2
        assert "stage 'images' reads this folder" in result.flat
    monkeypatch.setenv("PANO_MVS_CACHE", str(capture / "images" / ".." / "images"))
    result = pano_mvs("run", alone)
    assert (result.code, "$PANO_MVS_CACHE" in result.flat) == (2, True)
    assert {path.suffix for path in (capture / "images").iterdir()} == {".png"}


def test_cache_among_the_images_is_left_out(pano_mvs: Command, alone: Path, capture: Path) -> None:
    cache = capture / "images" / "cache"
    assert pano_mvs("run", alone, "--cache", cache, "--out", "out").code == 0
    (cache / "blobs" / "zz").mkdir()
    (cache / "blobs" / "zz" / "mask.png").write_bytes((capture / "images" / "000.png").read_bytes())
    assert pano_mvs("run", alone, "--cache", cache, "--out", "out").code == 0
    assert run_json(Path("out"))["stages"][0]["units"] == 4


def test_subfolder_that_cannot_be_listed_is_a_note(pano_mvs: Command, alone: Path, capture: Path) -> None:
    """An unreadable `lost+found` ended the run."""
    (capture / "images" / "lost+found").mkdir(mode=0)
    with permissions_hold():
        result = pano_mvs("run", alone, "--out", "out")
    assert result.code == 0, result.text
    assert run_json(Path("out"))["stages"][0]["units"] == 4
    notes = [note for note in run_json(Path("out"))["notes"] if "lost+found" in note]
    assert notes == [
        f"{capture / 'images' / 'lost+found'}: cannot be listed (Permission denied); its contents are skipped"
    ]


def test_image_that_may_not_be_read_costs_that_image(pano_mvs: Command, alone: Path, capture: Path) -> None:
    (capture / "images" / "inner").mkdir()
    (capture / "images" / "000.png").rename(capture / "images" / "inner" / "000.png")
    (capture / "images" / "inner").chmod(0o400)
    with permissions_hold():
        result = pano_mvs("run", alone, "--out", "out")
    (capture / "images" / "inner").chmod(0o700)
    assert result.code == 3, result.text
    assert "000.png: cannot be read (Permission denied)" in result.flat
