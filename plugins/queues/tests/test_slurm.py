"""The quickstart in jobs of a real SLURM, one of which is cancelled while it computes: the same bytes."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from tests.cli.conftest import SMALL, deliverables
from tests.cli.workflows.test_equivariance import stored

CONFIGURATION = """\
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/%n.log
MailProg=/bin/true
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=sched_min_interval=100000
KillWait=2
NodeName=node1 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[1]} CPUs=1 RealMemory=4000
NodeName=node2 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[2]} CPUs=1 RealMemory=4000
PartitionName=work Nodes=node1,node2 Default=YES State=UP
"""
READY_S = 30.0


class Slurm:
    """Its commands."""

    def __init__(self, environment: dict[str, str]) -> None:
        self.environment = environment

    def call(self, *command: str) -> str:
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def running(self) -> list[str]:
        """Return the ids of the running jobs, the oldest first."""
        return sorted(self.call("squeue", "--noheader", "--states=R", "--format=%i").split(), key=int)


@contextmanager
def slurm_cluster(folder: Path) -> Iterator[Slurm]:
    """Start the daemons, in a folder that need not exist; all jobs and daemons end with the context."""
    for name in ("state", "spool-node1", "spool-node2"):
        (folder / name).mkdir(parents=True)
    configuration = CONFIGURATION.format(host=socket.gethostname(), folder=folder, ports=_free_ports(3))
    (folder / "slurm.conf").write_text(configuration)
    slurm = Slurm(os.environ | {"SLURM_CONF": str(folder / "slurm.conf")})
    slurm.call("mungekey", "--create", "--keyfile", str(folder / "key"))
    files = [f"--{name}={folder / name}" for name in ("key-file", "pid-file", "log-file", "seed-file")]
    files[0] = f"--key-file={folder / 'key'}"
    daemons = [
        ["munged", "--force", "--foreground", f"--socket={folder / 'munge'}", *files],
        ["slurmctld", "-D"],
        ["slurmd", "-D", "-N", "node1"],
        ["slurmd", "-D", "-N", "node2"],
    ]
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for command in daemons:
            processes.append(subprocess.Popen(command, env=slurm.environment, stderr=subprocess.DEVNULL))
            _wait_for(folder / "munge")
        deadline = time.monotonic() + READY_S
        while "idle" not in (states := _states(slurm)) or len(states) > 1:
            assert time.monotonic() < deadline, (folder / "slurmctld.log").read_text()
            time.sleep(0.2)
        yield slurm
    finally:
        with suppress(AssertionError, FileNotFoundError):
            slurm.call("scancel", "--full", *slurm.running())
        for process in reversed(processes):
            process.terminate()
        for process in processes:
            process.wait(READY_S)


def _states(slurm: Slurm) -> set[str]:
    """Return the states of the nodes; empty while the controller starts."""
    with suppress(AssertionError):
        return set(slurm.call("sinfo", "--noheader", "--format=%T").split())
    return set()


def _wait_for(path: Path) -> None:
    deadline = time.monotonic() + READY_S
    while not path.exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _free_ports(count: int) -> list[int]:
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [int(one.getsockname()[1]) for one in sockets]
    for one in sockets:
        one.close()
    return ports


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
