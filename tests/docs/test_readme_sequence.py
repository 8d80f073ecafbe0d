"""The commands of the README work when they are entered one after the other, from the sample to a page."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import cv2
import pytest
from typer.testing import CliRunner

import pano_mvs
from pano_mvs.cli.app import app
from tests.docs.test_examples import commands
from tests.stored import read_picture

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SAMPLE = ROOT / "workflows" / "samples" / "classroom" / "images"
NAMES = ("hall.jpg", "kitchen.jpg", "lobby.jpg", "stairs.jpg")
SMALLER = {
    "images.max_width": 256,
    "views.sources": 2,
    "depth.planes": 24,
    "features.max_keypoints": 2000,
    "weak.learned": "never",
    "scene_planes.min_share": 0.1,
}
OF_SAMPLE = {"depth.planes": 96}  # as in the cache
MISSING = {"known_poses": ("scene_planes", "weak")}  # stages
NOT_RUN = ("pip", "docker", "pytest", "activate")


def sequences() -> list[tuple[str, str]]:
    """Return the marked blocks of commands, in order, with their names."""
    return re.findall(r"<!-- sequence: (\w+) -->\n```bash\n(.*?)```", README, re.DOTALL)


def test_every_block_of_commands_is_run_or_installs() -> None:
    marked = [text for _, text in sequences()]
    blocks = re.findall(r"^```(?:bash|console|powershell|text)\n(.*?)^```", README, re.DOTALL | re.MULTILINE)
    for block in blocks:
        assert block in marked or any(word in block for word in NOT_RUN), block
    assert len(marked) >= 4


def smaller(arguments: list[str]) -> list[str]:
    """Return a command that computes smaller images and opens no window."""
    if arguments[0] == "view":
        return [*arguments, "--screenshot", "view.png"]
    if arguments[0] not in ("run", "tour"):
        return arguments
    settings = OF_SAMPLE if arguments[1] == "quickstart" else SMALLER
    missing = MISSING.get(arguments[1], ())
    given = [f"{name}={value}" for name, value in settings.items() if name.partition(".")[0] not in missing]
    given += (
        ["textured.texture_px=512", "textured.cell=0.1", "textured.triangles=2000"] if arguments[0] == "tour" else []
    )
    quiet = ["--no-open"] if arguments[0] == "tour" else []
    return [*arguments, *quiet, *(word for setting in given for word in ("--set", setting))]


@pytest.mark.slow
def test_the_commands_run_one_after_the_other(tmp_path: Path, sample: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lobby = tmp_path / "photos" / "lobby"
    lobby.mkdir(parents=True)
    for name, path in zip(NAMES, sorted(SAMPLE.iterdir()), strict=True):
        cv2.imwrite(str(lobby / name), read_picture(path))
    shutil.copytree(ROOT / "workflows", tmp_path / "workflows", ignore=shutil.ignore_patterns(".pano-mvs"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PANO_MVS_CACHE", str(sample / "cache"))
    monkeypatch.setenv("COLUMNS", "200")
    for _, script in sequences():
        for arguments in commands(script):
            result = CliRunner().invoke(app, smaller(arguments))
            finished = (
                (0, 3) if arguments[0] in ("run", "tour") else (0,)
            )  # 3: a camera may be doubtful at this resolution
            assert result.exit_code in finished, f"{shlex.join(arguments)}:\n{result.output}"
    for made in (
        "classroom_page/index.html",
        "out/lobby_page/index.html",
        "lobby_page/index.html",
        "curve.png",
        "view.png",
        "errors",
    ):
        assert (tmp_path / made).exists(), made
    check_python()


def check_python() -> None:
    """Run the README's Python on the results of its commands: nothing is computed again."""
    found = re.search(r"```python\n(import pano_mvs\n.*?)```", README, re.DOTALL)
    assert found

    def run(*arguments: Any, **named: Any) -> pano_mvs.RunOutput:
        return pano_mvs.run(*arguments, **named, settings=SMALLER)

    names: dict[str, Any] = {"smaller": run}
    exec(found[1].replace("pano_mvs.run(", "smaller("), names)
    assert names["run"].summary.units.run == 0
    assert names["range_map"].shape == (128, 256)
