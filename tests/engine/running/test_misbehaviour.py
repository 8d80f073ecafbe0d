"""Whatever a stage of a plugin does, it costs the unit that does it, the run ends, and the cache can be read."""

from __future__ import annotations

import re
import sys
import textwrap
import threading
from pathlib import Path

import pytest

from pano_mvs.core.errors import PluginError
from pano_mvs.engine.cache.store import Store
from pano_mvs.results.run_output import RunOutput
from pano_mvs.session.running import Execution, run_session
from tests.engine.conftest import PATIENCE_S, Toy, toy_in

MISBEHAVIOURS = {
    "nan": ("ctx.metrics['x'] = float('nan')", r"ctx\.metrics\['x'\] is nan: ctx\.metric\(name, value\) leaves such"),
    "inf": ("ctx.metrics['x'] = float('inf')", r"ctx\.metrics\['x'\] is inf"),
    "negative inf": ("ctx.metrics['x'] = -float('inf')", r"ctx\.metrics\['x'\] is -inf"),
    "numpy nan": ("import numpy\nctx.metrics['x'] = numpy.float32('nan')", r"ctx\.metrics\['x'\] is nan"),
    "integer without end": ("ctx.metrics['x'] = 10 ** 400", "OverflowError"),
    "object": ("ctx.metrics['x'] = object()", r"ctx\.metrics\['x'\] is a value of type object, not a number"),
    "none": ("ctx.metrics['x'] = None", r"ctx\.metrics\['x'\] is None, not a number"),
    "string": ("ctx.metrics['x'] = 'much'", r"ctx\.metrics\['x'\] is a value of type str, not a number"),
    "huge string": (
        "ctx.metrics['x'] = 'x' * 100_000_000",
        r"ctx\.metrics\['x'\] is a value of type str, not a number",
    ),
    "huge name": ("ctx.metrics['x' * 100_000_000] = 1.0", r"the name of a metric has 100,000,000 characters"),
    "dict": ("ctx.metrics['x'] = {i: i for i in range(10 ** 6)}", r"ctx\.metrics\['x'\] is a value of type dict"),
    "huge dict": (
        "ctx.metrics.update({str(i): i for i in range(10 ** 6)})",
        r"ctx\.metrics has more than 1,000 entries, which is the most",
    ),
    "number as a name": ("ctx.metrics[3] = 1.0", r"the name of a metric is a value of type int"),
    "no metrics": ("ctx.metrics = None", "TypeError"),
    "object in notes": ("ctx.notes.append(object())", r"a note is a value of type object, not a text"),
    "dict in notes": (
        "ctx.notes.append({i: i for i in range(10 ** 6)})",
        r"a note is a value of type dict, not a text",
    ),
    "huge string in notes": ("ctx.notes.append('x' * 100_000_000)", r"a note has 100,000,000 characters"),
    "string for notes": ("ctx.notes = 'note'", r"ctx\.notes is a value of type str, not a list"),
    "reason that is no text": (
        "ctx.rejected['a.jpg'] = 7",
        r"a reason in ctx\.rejected is a value of type int, not a text",
    ),
    "exit": ("raise SystemExit(0)", "SystemExit: 0"),
    "exit by the library": ("import sys\nsys.exit('enough')", "SystemExit: enough"),
    "interrupt of its own": ("class Stop(KeyboardInterrupt): pass\nraise Stop('now')", "Stop: now"),
    "cancelled": ("import asyncio\nraise asyncio.CancelledError", "CancelledError"),
    "generator exit": ("raise GeneratorExit", "GeneratorExit"),
    "notes of an error": ("error = ValueError('odd')\nerror.__notes__ = 5\nraise error", r"ValueError \(TypeError: "),
    "interrupt as its message": (
        "class Odd(Exception):\n    def __str__(self): raise KeyboardInterrupt\nraise Odd",
        r"Odd: \(its message cannot be shown: KeyboardInterrupt\)",
    ),
    "exit as its note": (
        "class Odd:\n    def __str__(self): raise SystemExit(0)\n"
        "error = ValueError('odd')\nerror.__notes__ = [Odd()]\nraise error",
        r"ValueError \(SystemExit: 0\)",
    ),
    "end as its message": (
        "class End(BaseException):\n    def __str__(self): raise End\nraise End",
        r"End: \(its message cannot be shown: End\)",
    ),
    "many notes": ("ctx.notes = ['odd'] * 10_001", r"ctx\.notes has more than 10,000 entries"),
    "many images": (
        "ctx.rejected = {f'{number}.jpg': 'odd' for number in range(200_000)}",
        r"ctx\.rejected has more than 100,000 entries",
    ),
    "text of another length": (
        "class Short(str):\n    def __len__(self): return 1\nctx.notes.append(Short('x' * 20_000))",
        r"a note has 20,000 characters",
    ),
    "number of another value": (
        "class Odd(float):\n    def __float__(self): return float('nan')\nctx.metrics['x'] = Odd(1)",
        r"ctx\.metrics\['x'\] is nan",
    ),
    "no memory": ("raise MemoryError", "MemoryError"),
    "too much memory": ("bytearray(1 << 62)", "MemoryError"),
    "recursion": ("def again(): return again()\nagain()", "RecursionError"),
    "streams": (
        "import sys\nfor each in (sys.stdout, sys.stderr, sys.__stdout__, sys.__stderr__): each.close()\n"
        "raise ValueError('closed')",
        "ValueError: closed",
    ),
    "descriptors": ("os.close(1)\nos.close(2)\nraise ValueError('closed')", "ValueError: closed"),
    "half a character": (r"ctx.notes.append('\ud800')" + "\nraise ValueError('\\ud800')", "ValueError: "),
}
"""What a stage does, and the reason that its unit has failed."""

WRITE_TO_ALL = """for number in range(3, 30):
    try: os.write(number, {line})
    except OSError: pass
time.sleep(600)"""

FATAL = {
    "interrupt of the user": ("raise KeyboardInterrupt", "KeyboardInterrupt"),
    "exit at once": ("os._exit(0)", r"its worker process died \(exit code 0\)"),
    "killed": ("os.kill(os.getpid(), 9)", r"its worker process died \(killed by SIGKILL, as the system does when mem"),
    "lines for us": (WRITE_TO_ALL.format(line=r"b'[\n'"), r"an answer that cannot be read \(JSONDecodeError"),
    "deep lines for us": (WRITE_TO_ALL.format(line=r"b'[' * 60_000 + b'\n'"), r"cannot be read \(RecursionError"),
    "memory": (
        "import resource\nused = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "hard = resource.getrlimit(resource.RLIMIT_AS)[1]\n"
        "resource.setrlimit(resource.RLIMIT_AS, (used + (200 << 20), hard))\nblocks = []\n"
        "while True: blocks.append(bytearray(1000))",
        "MemoryError|worker process died",
    ),
    "all descriptors": (
        "os.closerange(0, 100)\nraise ValueError('closed')",
        r"Bad file descriptor|worker process died",
    ),
}
"""What ends the command with `--executor serial`, which computes in its process."""

HARMLESS = {
    "closed streams": "import sys\nfor each in (sys.stdout, sys.stderr, sys.__stdout__, sys.__stderr__): each.close()",
    "closed descriptors": "os.close(1)\nos.close(2)",
    "detached stream": "import io, sys\nsys.stdout = io.TextIOWrapper(sys.stdout.detach(), encoding='utf-8')",
    "low recursion limit": "import sys\nframe, depth = sys._getframe(), 20\n"
    "while frame := frame.f_back: depth += 1\nsys.setrecursionlimit(depth)",
    "long note": "ctx.note('x' * 100_000_000)",
    "half a character": r"ctx.note('\ud800'); ctx.metric('\ud800', 1.0); ctx.reject('\ud800', '\ud800')",
}


# A stage that detaches a stream leaves a file to be closed by the garbage collector.
UNCLOSED = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
NEEDS_LINUX = pytest.mark.skipif(sys.platform != "linux", reason="signals, limits and /proc of Linux")
WAYS = [
    pytest.param(("serial", MISBEHAVIOURS), id="serial", marks=UNCLOSED),
    pytest.param(("processes", MISBEHAVIOURS), id="processes", marks=pytest.mark.slow),
    pytest.param(("processes", FATAL), id="processes-fatal", marks=[pytest.mark.slow, NEEDS_LINUX]),
]
Misbehaved = tuple[dict[str, tuple[str, str]], Toy, RunOutput]


def run_or_give_up(toy: Toy, executor: str) -> RunOutput:
    """Run, and fail if the run does not end."""
    outputs: list[RunOutput] = []
    workers = 1 if executor == "serial" else 2
    execution = Execution(executor=executor, workers=workers, threads=1)
    thread = threading.Thread(target=lambda: outputs.append(run_session(toy.session(), execution)), daemon=True)
    thread.start()
    thread.join(PATIENCE_S)
    assert not thread.is_alive(), "the run does not end"
    return outputs[0]


def misbehave(folder: Path, executor: str, ways: dict[str, tuple[str, str]]) -> Misbehaved:
    """Run a capture in which five units of a stage are well-behaved, and each other one misbehaves in its way."""
    toy = toy_in(folder)
    code = ""
    for number, deed in enumerate([*(deed for deed, _ in ways.values()), *HARMLESS.values()], 100):
        toy.number(f"{number}.txt", str(number))
        code += f"if x.value == {number}:\n{textwrap.indent(deed, '    ')}\n"
    toy.begin(code)
    return ways, toy, run_or_give_up(toy, executor)


def check_reasons(misbehaved: Misbehaved) -> None:
    """Check that each unit that misbehaves fails with its reason, and no other one."""
    ways, _, output = misbehaved
    causes = {unit.item: unit.cause for unit in output.summary.failures if unit.stage == "scaled"}
    found = {what: causes.pop(f"{number}.txt", "") for number, what in enumerate(ways, 100)}
    assert {what: cause for what, cause in found.items() if not re.search(ways[what][1], cause)} == {}
    assert causes == {}, "others go on"


def check_others(misbehaved: Misbehaved) -> None:
    """Check that all others were computed and stored."""
    _, toy, output = misbehaved
    assert output.summary.exit_code == 3
    (scaled,) = (stage for stage in output.summary.stages if stage.name == "scaled")
    assert scaled.run == 5 + len(HARMLESS)
    assert (toy.folder / "out" / "report.html").is_file()
    store = Store(toy.folder / "cache")
    assert len(toy.plan()["scaled"].cached) == 5 + len(HARMLESS)
    assert store.damaged == []
    assert not list((toy.folder / "cache" / "tmp").iterdir())


@pytest.fixture(scope="module", params=WAYS)
def misbehaved(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Misbehaved:
    executor, ways = request.param
    return misbehave(tmp_path_factory.mktemp("misbehaved"), executor, ways)


def test_a_unit_that_misbehaves_fails_with_the_reason(misbehaved: Misbehaved) -> None:
    """NaN in the metrics of a plugin ended the thread that served its worker, and the run waited for ever."""
    check_reasons(misbehaved)


def test_the_others_go_on_and_the_cache_stays_readable(misbehaved: Misbehaved) -> None:
    check_others(misbehaved)


def test_what_a_value_consists_of_is_the_plugins_error(toy: Toy) -> None:
    """The line named was one of the engine's."""
    toy.edit(
        "plug.py",
        lambda text: text.replace("    def explode(self):\n", "    def explode(self):\n        return None\n"),
    )
    (failure,) = toy.run().failures
    assert re.search(r"plug\.py:\d+: AttributeError: 'NoneType'", failure.cause)


def test_a_function_for_the_memory_of_loading_is_checked(toy: Toy) -> None:
    """A huge number overflowed where it was shown as text."""
    function = "    def loading_bytes(self):\n        return 10 ** 400\n"
    toy.edit("plug.py", lambda text: text.replace("    value: float\n", f"    value: float\n\n{function}", 1))
    causes = {failure.cause for failure in toy.run().failures}
    assert causes == {"loading_bytes of Number must return a number of bytes from 0 to 9223372.0 TB"}


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("raise ValueError('odd')", r"plug\.py:\d+: ValueError: odd"),
        ("raise SystemExit(0)", r"plug\.py:\d+: SystemExit: 0"),
        ("class End(BaseException): pass\n    raise End('now')", r"plug\.py:\d+: End: now"),
        ("class Stop(KeyboardInterrupt): pass\n    raise Stop('now')", r"plug\.py:\d+: Stop: now"),
        ("return 10 ** 400", r"memory of stage toy\.mean \(.*plug\.py:\d+\) must return a number of bytes from 0"),
        ("return -1", r"memory of stage toy\.mean \(.*plug\.py:\d+\) must return a number of bytes from 0"),
        ("return float('nan')", r"plug\.py:\d+: ValueError: cannot convert float NaN to integer"),
        ("return float('inf')", "OverflowError: cannot convert float infinity to integer"),
        ("return 'much'", "ValueError: invalid literal"),
    ],
)
def test_a_function_for_the_memory_that_fails_costs_its_units(toy: Toy, code: str, reason: str) -> None:
    """It is called in the main process: the command ended with a traceback, or with exit code 0.

    Any number was accepted, and a huge one overflowed where it was shown as text.
    """
    marked = '@stage("toy.mean")'
    function = f"def needed(params, inputs):\n    {code}\n\n"
    toy.edit("plug.py", lambda text: text.replace(marked, f'{function}@stage("toy.mean", memory=needed)'))
    result = toy.run()
    causes = [failure.cause for failure in result.failures]
    assert [bool(re.search(reason, cause)) for cause in causes] == [True] * 5
    assert result.exit_code == 3


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        (
            "raise ValueError('odd')",
            r"images: source toy\.source cannot list its items: .*plug\.py:\d+: ValueError: odd",
        ),
        ("raise SystemExit(0)", r"plug\.py:\d+: SystemExit: 0"),
        ("class End(BaseException): pass\n    raise End('now')", r"plug\.py:\d+: End: now"),
        (
            "class Odd(Exception):\n        def __str__(self): raise ValueError\n    raise Odd",
            r"plug\.py:\d+: Odd: \(its message cannot be shown: ValueError\)",
        ),
        ("return None", r"plug\.py:\d+: TypeError: 'NoneType' object is not iterable"),
        ("return 3", r"plug\.py:\d+: TypeError: 'int' object is not iterable"),
        ("return ['1.txt']", r"plug\.py:\d+: TypeError: an item is a str, not a SourceItem"),
    ],
)
def test_a_source_that_cannot_list_its_items_is_the_plugins_error(toy: Toy, code: str, reason: str) -> None:
    """The command called it a bug of its own."""
    begin = "def list_items(params):\n"
    rest = '    for path in sorted(params.path.glob("*.txt")):\n        yield SourceItem(path.name, {"text": path})\n'
    toy.edit("plug.py", lambda text: text.replace(begin + rest, f"{begin}    {code}\n"))
    with pytest.raises(PluginError, match=reason):
        toy.run()
