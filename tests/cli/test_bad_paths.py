"""Paths that cannot be looked at, and folders of ours in the wrong place: a message and an exit code, no traceback."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.conftest import Command, run_json
from tests.permissions import permissions_hold
from tests.share.box_run import box_run

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
    "evaluate cloud PATH --truth PATH",
    "evaluate poses PATH --truth PATH",
    "evaluate depth . --truth PATH",
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
        "view {}",
        "view o --screenshot {}",
        "share {} --to p",
        "share o --to {}",
        "share o --to p --rooms {}",
        "calibrate {} --out c.yaml",
        "calibrate photos --out {}",
        "merge o1 {} --out o",
        "plugins --plugin {}",
        "plugin new stage s --dir {}",
        "cache push {}",
        "doctor --out {}",
    ],
)
def test_an_empty_path_is_refused(pano_mvs: Command, command: str) -> None:
    """A variable of the shell without a value stood for the current folder, which `share` and `run` then filled."""
    result = pano_mvs(*(word.format("") for word in command.split()))
    assert result.code == 2
    assert "the name is empty" in result.flat
    assert not any(Path().iterdir())


def test_a_place_below_a_file_is_a_mistake_and_no_full_disk(pano_mvs: Command, tmp_path: Path) -> None:
    """`share` advised to free some space, with the exit code of a full disk."""
    run = box_run(tmp_path, points=200)
    Path("afile").touch()
    for command in (
        ("share", run.out, "--to", "afile/x"),
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
