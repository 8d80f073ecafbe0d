"""`plugin new`: for each kind a plugin that keeps its contract, is clean, and runs in a workflow, with its test."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.cli.plugins.new import EXAMPLES, KINDS, rendered, rendered_package
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.io.poses.files import read_poses
from pano_mvs.testing.tiny_capture import Variant, tiny_capture
from tests.cli.conftest import Command, deliverables, run_json
from tests.engine.conftest import Toy

ROOT = Path(__file__).parent.parent.parent
WORKFLOW = """\
pano_mvs: 1
name: mine
plugins: [{files}]
stages:
  images:   {{use: source.new_source, path: {images}, nadir_deg: 20}}
  masked:   {{use: mask.new_mask}}
  features: {{use: features.new_features}}
  pairs:    {{use: pairs.new_pairs}}
  matches:  {{use: matches.new_matches}}
  poses:    {{use: poses.new_poses, step: 0.3}}
  views:    {{use: views.new_views}}
  depth:    {{use: depth.new_depth}}
  swept:    {{use: depth.sweep, planes: 8, near: 0.5, far: 6, backend: numpy, cost: new_sweep_cost, aggregation: box}}
  again:    {{use: depth.sweep, planes: 8, near: 0.5, far: 6, backend: new_sweep_backend, cost: sad, aggregation: box}}
  filtered: {{use: filters.new_filter, far: 5, in: {{range_map: depth}}}}
  cloud:    {{use: fusion.new_fusion, min_confidence: 1, in: {{ranges: filtered}}}}
  written:  {{use: export.new_export, in: {{range_map: filtered}}}}
  ply:      {{use: export.ply}}
"""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("new")
    for kind in KINDS:
        for name, text in zip((f"new_{kind}.py", f"test_new_{kind}.py"), rendered(kind, f"new_{kind}"), strict=True):
            (folder / name).write_text(text)
    return folder


@pytest.mark.slow
@pytest.mark.usefixtures("mine")
def test_new_plugins_run_in_a_workflow(pano_mvs: Command, written: Path) -> None:
    files = ", ".join(str(written / f"new_{kind}.py") for kind in KINDS)
    images = tiny_capture(Variant((32, 64))).folder / "images"
    Path("mine.yaml").write_text(WORKFLOW.format(files=files, images=images))
    result = pano_mvs("run", "mine.yaml")
    assert result.code == 0, result.text
    found = deliverables(Path("out/mine"))
    assert len([name for name in found if name.startswith("new_export/")]) == 4
    assert len(found["cloud.ply"]) > 40_000


def written_into(folder: Path, kind: str) -> None:
    (folder / f"mine_{kind}.py").write_text(rendered(kind, f"mine_{kind}")[0])


def test_a_new_command_prints_the_cameras_of_a_run(
    pano_mvs: Command, mine: Path, quickstart: tuple[Path, str], toy: Toy
) -> None:
    written_into(mine, "command")
    result = pano_mvs("mine_command", quickstart[0])
    assert result.code == 0, result.text
    assert [line.partition(",")[0] for line in result.text.splitlines()] == [
        "image",
        *(f"{n:03d}.png" for n in range(4)),
    ]
    assert pano_mvs("mine_command", quickstart[0], "--doubtful").text == "image,x,y,z\n"
    assert pano_mvs("run", toy.folder / "wf.yaml", "--out", "toy").code == 0
    result = pano_mvs("mine_command", "toy")
    assert (result.code, result.flat[:37]) == (2, "error: toy: this run has no poses; run"[:37])


def test_a_new_executor_rests_after_each_unit(
    pano_mvs: Command, mine: Path, toy: Toy, monkeypatch: pytest.MonkeyPatch
) -> None:
    written_into(mine, "executor")
    rests: list[float] = []
    monkeypatch.setattr("time.sleep", rests.append)
    result = pano_mvs("run", toy.folder / "wf.yaml", "--executor", "mine_executor")
    assert result.code == 0, result.text
    assert len(rests) >= 28
    result = pano_mvs("run", toy.folder / "wf.yaml", "--mine_executor-rest", "much")
    assert result.code == 2
    assert "--mine_executor-rest much: must be a number such as 0.5" in result.flat


def test_a_new_observer_writes_how_runs_have_ended(pano_mvs: Command, mine: Path, toy: Toy) -> None:
    written_into(mine, "observer")
    toy.number("3.txt", "13")
    arguments = ("run", toy.folder / "wf.yaml", "--executor", "serial", "--mine_observer", "runs.txt")
    assert pano_mvs(*arguments).code == 3
    assert pano_mvs(*arguments, "--workers", "2").code == 2
    first, second = (line.split("\t") for line in Path("runs.txt").read_text().splitlines())
    assert first[2].startswith("exit code 3, finished, ")
    assert first[3:] == ["scaled:3.txt"]
    assert second[2].startswith("exit code 2, --executor serial runs one unit at a time")
    result = pano_mvs(*arguments[:-1], "no/such/runs.txt")
    assert result.code == 3
    assert "warning: no/such/runs.txt: cannot be written (No such file or directory)" in result.flat


def test_a_new_pose_reader_reads_its_example(mine: Path, tmp_path: Path) -> None:
    written_into(mine, "pose_reader")
    Registry.installed()
    path = tmp_path / "poses.txt"
    path.write_text(EXAMPLES["pose_reader"].format(name="mine_pose_reader"))
    poses = read_poses(path)
    assert poses.names == ("a.jpg", "b.jpg")
    np.testing.assert_allclose(poses.centers, [(1.5, 2.0, 1.7), (2.5, 2.0, 1.7)])
    east = poses.cameras["a.jpg"].apply([11.5, 2.0, 0.7])  # ten metres in front, one below
    np.testing.assert_allclose(east, [0, 1, 10], atol=1e-12)


def test_a_new_capture_reader_reads_its_list(pano_mvs: Command, mine: Path, toy: Toy) -> None:
    written_into(mine, "capture_reader")
    shutil.copytree(tiny_capture(Variant((32, 64))).folder / "images", "attic")
    Path("photos.txt").write_text("# mine_capture_reader: one image per line\nattic/001.png\nattic/002.png\n")
    Path("look.yaml").write_text("pano_mvs: 1\nstages: {images: {use: source.folder, path: photos}}\n")
    result = pano_mvs("run", "look.yaml", "--images", "photos.txt", "--executor", "serial")
    assert result.code == 0, result.text
    assert [stage["units"] for stage in run_json(Path("out/look"))["stages"]] == [2]


@pytest.mark.slow
def test_a_run_knows_readers_of_files_from_the_start(
    mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a process of its own, in which nothing has imported the user's files before."""
    monkeypatch.chdir(tmp_path)
    written_into(mine, "capture_reader")
    shutil.copytree(tiny_capture(Variant((32, 64))).folder / "images", "attic")
    Path("photos.txt").write_text("# mine_capture_reader: one image per line\nattic/001.png\n")
    Path("look.yaml").write_text("pano_mvs: 1\nstages: {images: {use: source.folder, path: photos}}\n")
    command = [sys.executable, "-m", "pano_mvs", "run", "look.yaml", "--images", "photos.txt", "--executor", "serial"]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


def test_new_plugins_are_clean(written: Path) -> None:
    for command in (["check"], ["format", "--check"]):
        ruff = [sys.executable, "-m", "ruff", *command, "--config", str(ROOT / "pyproject.toml"), str(written)]
        result = subprocess.run(ruff, capture_output=True, text=True)
        assert result.returncode == 0, result.stdout


@pytest.mark.slow
def test_new_plugins_are_typed_and_their_tests_pass(written: Path, tmp_path: Path) -> None:
    """What was found of pano_mvs when the checkout was checked is used again, if it was."""
    known = (f"--config-file={ROOT / 'pyproject.toml'}", f"--cache-dir={ROOT / '.mypy_cache'}")
    mypy = [sys.executable, "-m", "mypy", "--strict", *known, *map(str, written.glob("new_*.py"))]
    own = [sys.executable, "-m", "pytest", "-q", "-W", "error", "--basetemp", str(tmp_path / "own"), str(written)]
    for command in (mypy, own):
        result = subprocess.run(command, cwd=written, capture_output=True, text=True)
        assert result.returncode == 0, result.stdout + result.stderr


def test_the_command_writes_both_files_and_overwrites_none(pano_mvs: Command) -> None:
    result = pano_mvs("plugin", "new", "filter", "mine", "--dir", "plugins/here")
    assert result.code == 0, result.text
    assert "filtered: {use: filters.mine}" in result.flat
    assert Path("plugins/here/mine.py").read_text() == rendered("filter", "mine")[0]
    Path("plugins/here/mine.py").unlink()
    result = pano_mvs("plugin", "new", "filter", "mine", "--dir", "plugins/here")
    assert result.code == 2
    assert "test_mine.py already exists" in result.flat
    assert not Path("plugins/here/mine.py").exists()


def test_the_command_says_how_a_plugin_beside_stages_is_used(pano_mvs: Command) -> None:
    result = pano_mvs("plugin", "new", "observer", "bell", "--dir", "here")
    assert result.code == 0, result.text
    assert (
        "put bell.py into a folder that $PANO_MVS_PLUGINS names, and run pano-mvs run quickstart --bell" in result.flat
    )


@pytest.mark.parametrize(
    ("kind", "name", "what"),
    [
        ("filters", "mine", "unknown kind of plugin 'filters'; known kinds: source, mask"),
        ("filter", "../mine", "cannot be called '../mine'"),
        ("filter", "Mine", "cannot be called 'Mine'"),
        ("filter", "class", "cannot be called 'class'"),
        ("filter", "json", "would hide the Python package"),
        ("filter", "numpy", "would hide the Python package"),
        ("filter", "median", "filters.median exists already as another filter"),
        ("command", "run", "run exists already as another command"),
        ("command", "cache", "cache exists already"),
        ("executor", "serial", "serial exists already as another executor"),
        ("observer", "workers", "workers exists already as another observer or option"),
    ],
)
def test_what_cannot_be_written_is_refused(pano_mvs: Command, kind: str, name: str, what: str) -> None:
    result = pano_mvs("plugin", "new", kind, name)
    assert result.code == 2
    assert what in result.flat


def test_kinds_are_listed(pano_mvs: Command) -> None:
    result = pano_mvs("plugin", "kinds")
    assert result.code == 0
    assert all(kind in result.text for kind in KINDS)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if KINDS[kind].prefix])
def test_a_package_with_an_environment_of_its_own_has_the_stage_of_a_file(kind: str) -> None:
    files = rendered_package(kind, "mine", "isolated")
    assert files["mine/__init__.py"] == rendered(kind, "mine")[0]
    project = tomllib.loads(files["pyproject.toml"])
    assert project["project"]["name"] == "mine"
    assert project["project"]["entry-points"] == {"pano_mvs.plugins": {"mine": "mine"}}
    assert project["tool"]["pano_mvs"] == {"environment": "isolated"}
    compile(files["test_mine.py"], "test_mine.py", "exec")


@pytest.mark.slow
def test_a_package_is_written_and_its_test_passes(pano_mvs: Command) -> None:
    result = pano_mvs("plugin", "new", "filter", "mine", "--environment", "overlay", "--dir", "some where")
    assert result.code == 0, result.text
    assert "wrote the package some where/mine and its test" in result.flat
    assert "pano-mvs plugin install 'some where/mine'" in result.flat
    tests = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "some where/mine/test_mine.py"]
    done = subprocess.run(tests, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    again = pano_mvs("plugin", "new", "filter", "mine", "--environment", "overlay", "--dir", "some where")
    assert (again.code, "some where/mine already exists; nothing was written" in again.flat) == (2, True)


def test_environments_are_for_stages(pano_mvs: Command) -> None:
    result = pano_mvs("plugin", "new", "command", "mine", "--environment", "overlay")
    assert (result.code, "brings stages: source, mask," in result.flat) == (2, True)
    result = pano_mvs("plugin", "new", "filter", "mine", "--environment", "own")
    assert (result.code, "--environment own: must be overlay or isolated" in result.flat) == (2, True)
    assert not list(Path().iterdir())
