"""The toy capture for stress: every stage takes a while, arrays and files are stored, and there are more units."""

from __future__ import annotations

import os
import re
import time
from pathlib import Path

from tests.engine.toy import HELPER, PLUGIN, WORKFLOW

EXEMPT = ("run.json", "report.html", "logs", ".pano-mvs-output")
SLEEP_VARIABLE = "TOY_SLEEP_S"
HOLD_VARIABLE = "TOY_HOLD"
"""Names a folder. A unit of a stage waits while a file there has the stage's name, and writes its process into `met`.

If the content of that file is "eat", it takes memory without end instead.
"""

_HOLD = """

def _hold(name):
    time.sleep(float(os.environ.get("TOY_SLEEP_S", "0")))
    folder = os.environ.get("TOY_HOLD", "")
    if not folder:
        return
    path = os.path.join(folder, name)
    try:
        with open(path) as stream:
            eaten = ["x"] if stream.read() == "eat" else []
    except FileNotFoundError:
        return
    if eaten:
        os.remove(path)
    with open(os.path.join(folder, f"met-{os.getpid()}"), "w") as stream:
        stream.write(str(os.getpid()))
    os.replace(stream.name, os.path.join(folder, "met"))
    while eaten:
        eaten.append("x" * (10_000_000 + len(eaten)))
    while os.path.exists(path):
        time.sleep(0.01)
"""

_TABLE = '''
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Table(Record):
    """Some megabytes of numbers."""
    axis: ClassVar[Axis | None] = Axis.IMAGE
    rows: NDArray[np.float32]


@stage("toy.table")
def table(x: Each[Number], ctx: Context) -> Table:
    """Many numbers from one."""
    return Table((ctx.rng.random((300, 500)) * x.value).astype(np.float32))


@stage("toy.write_table")
def write_table(table: Each[Table], ctx: Context) -> Files:
    """Their sums."""
    path = ctx.scratch / "sums.txt"
    path.write_text(str(table.rows.sum(axis=1).tolist()))
    np.save(ctx.scratch / "rows.npy", table.rows)
    return Files({"tables/{item}.txt": path, "tables/{item}.npy": ctx.scratch / "rows.npy"})
'''
_STAGE = re.compile(r'(@(?:stage|source)\("(toy\.\w+)"[^\n]*\)\ndef [^\n]*\n    """[^\n]*"""\n)')
TOY_STAGES: tuple[str, ...] = tuple(name for _, name in _STAGE.findall(PLUGIN + _TABLE))


def write_toy(folder: Path, *, numbers: int = 16) -> Path:
    """Write the capture and its workflow into a folder; return the workflow."""
    (folder / "capture").mkdir(parents=True)
    (folder / "plug.py").write_text(_STAGE.sub(r'\1    _hold("\2")' + "\n", PLUGIN + _TABLE + _HOLD))
    (folder / "helper.py").write_text(HELPER)
    more = "  table:      {use: toy.table, in: {x: scaled}}\n  tables:     {use: toy.write_table}\n"
    (folder / "wf.yaml").write_text(WORKFLOW + more)
    past = time.time() - 60  # so that the digests are remembered
    for number in range(1, numbers + 1):
        path = folder / "capture" / f"{number}.txt"
        path.write_text(str(10 * number))
        os.utime(path, (past, past))
    return folder / "wf.yaml"


def deliverables(out: Path) -> dict[str, bytes]:
    """Return the files of an output folder, but for those that carry times."""
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.relative_to(out).parts[0] not in EXEMPT
    }
