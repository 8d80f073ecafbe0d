from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from pano_mvs.core.locks import locked
from pano_mvs.testing.room import capture_poses, default_room
from tests.engine.conftest import finished, finished_once, toy
from tests.synthetic.capture_files import write_capture

__all__ = ["finished", "finished_once", "toy"]

SIZE_HW = (160, 320)
SMALL = ("--set", "depth.planes=32", "--set", "features.max_keypoints=1500")


@dataclass
class Outcome:
    code: int
    text: str

    @property
    def flat(self) -> str:
        """The output without line breaks, which depend on the width of the terminal."""
        return " ".join(self.text.split())


Command = Callable[..., Outcome]


@pytest.fixture(scope="session")
def of_all_processes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that all processes of the test run share."""
    folder = tmp_path_factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


@pytest.fixture(scope="session")
def rendered(of_all_processes: Path) -> Path:
    """Four rendered panoramas of the synthetic room with their truth; not to be changed."""

    def write(folder: Path) -> None:
        write_capture(folder, default_room(), capture_poses(4, spread=0.4), size_hw=SIZE_HW)

    return made_once(of_all_processes / "rendered", write)


@pytest.fixture(scope="session")
def quickstart(rendered: Path, of_all_processes: Path) -> tuple[Path, str]:
    """Output folder, beside its cache, and text of a quickstart run on the rendered capture; not to be changed."""

    def run(folder: Path) -> None:
        arguments = (
            *f"run quickstart --images {rendered / 'images'} --out {folder / 'out'} --cache {folder / 'cache'}".split(),
            *f"--set scores.truth={rendered / 'truth'}".split(),
            *SMALL,
        )
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, result.output
        (folder / "printed.txt").write_text(result.output, encoding="utf-8")

    folder = made_once(of_all_processes / "quickstart", run)
    return folder / "out", (folder / "printed.txt").read_text(encoding="utf-8")


def made_once(folder: Path, make: Callable[[Path], None]) -> Path:
    """Return a folder that the first process of the test run to ask for it makes; the others wait."""
    done = folder.with_name(f"{folder.name}.done")
    with locked(folder.with_name(f"{folder.name}.lock")):
        if not done.exists():
            folder.mkdir()
            make(folder)
            done.touch()
    return folder


@pytest.fixture(scope="session")
def sample(of_all_processes: Path) -> Path:
    """Folder with output and cache of the quickstart on the sample, as the examples of the documentation run it.

    Nobody is to change `out`; whoever runs the sample with `cache` computes little.
    """

    def run(folder: Path) -> None:
        places = ("--out", folder / "out", "--cache", folder / "cache")
        result = CliRunner().invoke(app, ["run", "quickstart", *map(str, places), "--set", "depth.planes=96"])
        assert result.exit_code == 0, result.output

    return made_once(of_all_processes / "sample", run)


@pytest.fixture
def capture(rendered: Path, tmp_path: Path) -> Path:
    """A copy of the rendered capture that a test may change."""
    return Path(shutil.copytree(rendered, tmp_path / "capture"))


@pytest.fixture
def pano_mvs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run the command line in a folder of its own."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.delenv("PANO_MVS_CACHE", raising=False)

    def call(*arguments: str | os.PathLike[str]) -> Outcome:
        result = CliRunner().invoke(app, [os.fspath(argument) for argument in arguments])
        return Outcome(result.exit_code, result.output)

    return call


def run_json(folder: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads((folder / "run.json").read_text())
    return summary


def deliverables(folder: Path) -> dict[str, bytes]:
    """Return the files of an output folder, also of its blocks, but for those that carry times."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
        and path.name not in ("run.json", "report.html")
        and "logs" not in path.relative_to(folder).parts
    }
