"""The jobs of queueing systems: their settings and scripts, and what is refused before a run."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pano_mvs_queues import queues
from pano_mvs_queues.dask_cluster import run_unit
from pano_mvs_queues.queues import SYSTEMS, QueueExecutor, cluster_class, job_settings, patient, read_queue

from pano_mvs.core.errors import UsageError, WorkflowError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.choose import ExecutorRequest, make_executor
from pano_mvs.engine.executors.protocol import JobOutcome

SETTINGS = """\
partition: long
project: p1234
cores: 16
memory: 30GiB
walltime: 04:00:00
jobs: 20
interface: lo
directives: [--qos=low]
prologue: [module load python]
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "queue.yaml"
    path.write_text(SETTINGS)
    return path


@pytest.fixture
def commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the commands that submit jobs on the PATH; they refuse."""
    if os.name != "posix":
        pytest.skip("the commands are scripts of a POSIX shell")
    for command in SYSTEMS.values():
        (tmp_path / command).write_text("#!/bin/sh\necho 'error: too many jobs' >&2\nexit 1\n")
        (tmp_path / command).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))


LINES = {
    "slurm": ["-p long", "-A p1234", "-n 1", "--cpus-per-task=16", "--mem=30G", "-t 04:00:00", "--qos=low"],
    "pbs": ["-q long", "-A p1234", "-l select=1:ncpus=16:mem=30GB", "-l walltime=04:00:00", "--qos=low"],
    "lsf": ["-q long", '-P "p1234"', "-n 16", "-W 04:00:00", "--qos=low"],
    "sge": ["-q long", "-P p1234", "-l h_rt=04:00:00", "--qos=low"],
}
MARKS = {"slurm": "#SBATCH", "pbs": "#PBS", "lsf": "#BSUB", "sge": "#$"}


@pytest.mark.usefixtures("commands")
@pytest.mark.parametrize("system", SYSTEMS)
def test_job_script(system: str, file: Path, tmp_path: Path) -> None:
    settings = job_settings(system, read_queue(file), places=5, logs=tmp_path / "jobs")
    job = cluster_class(system).job_cls("tls://host:8786", name="worker", **settings)
    lines = job.job_script().splitlines()
    assert [line for line in LINES[system] if f"{MARKS[system]} {line}" not in lines] == []
    assert lines.index("export OMP_NUM_THREADS=16") < lines.index("module load python") < len(lines) - 1
    command = lines[-1]
    assert command.startswith(f"{sys.executable} -m distributed.cli.dask_worker tls://host:8786 ")
    assert command.endswith(f"--nthreads 5 --resources memory={30 << 30} --interface lo")


def test_every_mistake_in_the_settings_has_its_line(tmp_path: Path) -> None:
    path = tmp_path / "queue.yaml"
    path.write_text("partitoin: long\ncores: none\nmemory: much\nwalltime: soon\nqueue: a\npartition: b\n")
    with pytest.raises(WorkflowError) as caught:
        read_queue(path)
    found = {line.removeprefix(f"{path}:").split(": ")[0]: line for line in caught.value.problems}
    assert sorted(found) == ["1:1", "2:8", "3:9", "4:11", "6:1"]
    assert "Did you mean 'partition'" in caught.value.problems[-2]
    assert "setting 'jobs' is missing" in str(caught.value)
    assert "must be a size such as 500MB" in found["3:9"]
    assert "must be a time such as 04:00:00" in found["4:11"]


@pytest.mark.parametrize("page", ["running.md", "tutorials/cluster.md"])
def test_documented_settings_are_valid(page: str, tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs" / page).read_text(encoding="utf-8")
    (example,) = re.findall(r"<!-- queue -->\n```yaml\n(.*?)```", text, re.DOTALL)
    path = tmp_path / "slurm.yaml"
    path.write_text(example)
    assert read_queue(path).jobs == 20


@pytest.mark.parametrize(("threads", "shape"), [(0, (10, 1)), (4, (4, 4))])
def test_units_of_a_job_share_its_cores_and_its_memory(threads: int, shape: tuple[int, int], file: Path) -> None:
    assert read_queue(file).shape(threads) == shape


def test_settings_must_be_a_mapping(tmp_path: Path) -> None:
    path = tmp_path / "queue.yaml"
    path.write_text("- cores\n")
    with pytest.raises(WorkflowError, match=r"queue\.yaml:1:1: must be a mapping with the keys cores, memory"):
        read_queue(path)


def test_what_is_missing_is_refused_with_the_remedy(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path / "cache")
    with pytest.raises(UsageError, match=r"--executor slurm requires --queue FILE\.yaml"):
        make_executor(store, ExecutorRequest("slurm"))
    with pytest.raises(UsageError, match=r"--queue requires --executor lsf or pbs or sge or slurm; processes has"):
        make_executor(store, ExecutorRequest("processes", options={"queue": str(file)}))
    with pytest.raises(UsageError, match=r"--workers has no effect .* set `jobs` in"):
        make_executor(store, ExecutorRequest("slurm", 2, options={"queue": str(file)}))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UsageError, match="there is no command sbatch on the PATH"):
        make_executor(store, ExecutorRequest("slurm", options={"queue": str(file)}))
    monkeypatch.setitem(sys.modules, "dask_jobqueue", None)
    with pytest.raises(UsageError, match=r"needs dask_jobqueue: pip install 'pano-mvs\[queues\]'"):
        make_executor(store, ExecutorRequest("slurm", options={"queue": str(file)}))


@pytest.mark.usefixtures("commands")
@pytest.mark.filterwarnings("ignore")  # of dask, whose loops are left to the collector
def test_an_interface_that_does_not_exist_is_refused_and_no_keys_stay(file: Path, tmp_path: Path) -> None:
    """It was reported as an internal error, and the keys of the connection stayed in the cache."""
    file.write_text(SETTINGS.replace("interface: lo", "interface: nothing0"))
    with pytest.raises(
        UsageError, match=r"'nothing0' is not a valid network interface.* Check `interface` in the file"
    ):
        make_executor(Store(tmp_path / "cache"), ExecutorRequest("slurm", options={"queue": str(file)}))
    assert not list((tmp_path / "cache" / "tmp").iterdir())


@pytest.mark.usefixtures("commands")
@pytest.mark.filterwarnings("ignore")
def test_no_keys_stay_if_the_scheduler_cannot_be_used(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(self: QueueExecutor, store: Store, cluster: Any) -> None:
        cluster.close()
        raise UsageError("it does not answer")

    monkeypatch.setattr(QueueExecutor, "_connect", fail)
    with pytest.raises(UsageError, match="it does not answer"):
        make_executor(Store(tmp_path / "cache"), ExecutorRequest("slurm", options={"queue": str(file)}))
    assert not list((tmp_path / "cache" / "tmp").iterdir())


@pytest.mark.usefixtures("commands")
def test_interrupts_are_still_interrupts(monkeypatch: pytest.MonkeyPatch) -> None:
    """dask-jobqueue replaces the handler when it is imported, so that a run would end without its report."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "dask_jobqueue"]:
        monkeypatch.delitem(sys.modules, name)
    before = signal.getsignal(signal.SIGINT)
    cluster_class("slurm")
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.usefixtures("commands")
def test_job_that_is_refused_is_submitted_again(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cluster submits the jobs that it plans and does not have, so a refused one must not stay among them."""
    monkeypatch.setattr(queues, "_RETRY_S", 0.0)
    kind = patient(cluster_class("slurm").job_cls)
    settings = job_settings("slurm", read_queue(file), places=5, logs=tmp_path / "jobs")

    async def submitted() -> dict[str, object]:
        job = kind("tls://host:8786", name="worker", **settings)
        workers: dict[str, object] = {"worker": job, "other": object()}
        cluster = SimpleNamespace(workers=workers)
        job._cluster = lambda: cluster
        await job
        await asyncio.sleep(0.01)
        return workers

    assert list(asyncio.run(submitted())) == ["other"]
    assert kind.refusals == ["error: too many jobs"]


def test_worker_that_joins_during_a_run_refuses_units_if_it_sees_another_cache(tmp_path: Path) -> None:
    (tmp_path / "tmp").mkdir()
    (tmp_path / "tmp" / "token").write_text("another folder")
    outcome = JobOutcome.from_json(json.loads(run_unit("a run", "{}", (str(tmp_path), "token"))))
    assert (outcome.status, outcome.error, outcome.exit_code) == ("stopped", "UsageError", 2)
    assert "does not see the cache" in outcome.cause
