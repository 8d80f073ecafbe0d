"""A queueing system for tests: SLURM with two nodes on this host, without accounting."""

from __future__ import annotations

import os
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

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
