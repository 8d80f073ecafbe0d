"""The toy capture for stress: every stage takes a while, arrays and files are stored, and there are more units."""

from __future__ import annotations

import os
import re
import time
from pathlib import Path

from tests.engine.toy import HELPER, PLUGIN, WORKFLOW

EXEMPT = ("run.json", "report.html", "logs", ".pano-mvs-output")
SLEEP_VARIABLE = "TOY_SLEEP_S"

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
_STAGE = re.compile(r'(@(?:stage|source)\([^\n]*\)\ndef [^\n]*\n    """[^\n]*"""\n)')


def write_toy(folder: Path, *, numbers: int = 16) -> Path:
    """Write the capture and its workflow into a folder; return the workflow."""
    slow = r'\1    time.sleep(float(os.environ.get("TOY_SLEEP_S", "0")))' + "\n"
    (folder / "capture").mkdir(parents=True)
    (folder / "plug.py").write_text(_STAGE.sub(slow, PLUGIN + _TABLE))
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
