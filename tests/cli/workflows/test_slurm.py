"""The quickstart in jobs of a real SLURM, one of which is cancelled while it computes: the same bytes."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.conftest import SMALL, deliverables
from tests.cli.workflows.test_executors_agree import stored
from tests.slurm import Slurm, slurm_cluster

pytestmark = pytest.mark.slurm

PATIENCE_S = 300.0


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Slurm]:
    with slurm_cluster(tmp_path_factory.mktemp("slurm")) as cluster:
        yield cluster


def start(
    folder: Path, images: Path, *options: str, environment: dict[str, str] | None = None
) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "pano_mvs", "run", "quickstart", "--images", str(images), *SMALL, *options]
    return subprocess.Popen(
        [*command, "--out", str(folder / "out"), "--cache", str(folder / "cache")],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment or dict(os.environ),
    )


def ended(process: subprocess.Popen[str], code: int) -> str:
    said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code, said
    return said


def queue_file(folder: Path, partition: str) -> str:
    path = folder / "queue.yaml"
    path.write_text(f"partition: {partition}\ncores: 1\nmemory: 3GB\nwalltime: 00:10:00\njobs: 2\n")
    return str(path)


def test_run_with_a_cancelled_job_gives_the_bytes_of_a_local_run(slurm: Slurm, rendered: Path, tmp_path: Path) -> None:
    local, queued = tmp_path / "local", tmp_path / "queued"
    ended(start(local, rendered), 0)
    options = ("--executor", "slurm", "--queue", queue_file(tmp_path, "work"))
    process = start(queued, rendered, *options, environment=slurm.environment)
    jobs = queued / "cache" / "jobs"
    deadline = time.monotonic() + PATIENCE_S
    while len(connected := [path for path in jobs.glob("*.err") if "Registered to" in path.read_text()]) < 2:
        assert process.poll() is None, process.stdout and process.stdout.read()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    victim = slurm.running()[0]
    slurm.call("scancel", victim)
    ended(process, 0)
    assert [path for path in connected if "CANCELLED" in path.read_text() and path.stem == f"pano-mvs-{victim}"]
    assert slurm.running() == []
    assert deliverables(queued / "out") == deliverables(local / "out")
    assert stored(queued / "cache") == stored(local / "cache")
    assert len(deliverables(local / "out")) > 10


def test_refused_job_ends_the_run(slurm: Slurm, rendered: Path, tmp_path: Path) -> None:
    options = ("--executor", "slurm", "--queue", queue_file(tmp_path, "none"))
    said = ended(start(tmp_path, rendered, *options, environment=slurm.environment), 2)
    assert "it refused the first job: sbatch: error: invalid partition specified: none" in " ".join(said.split())
