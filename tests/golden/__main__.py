"""Write down what the stages make now: `python -m tests.golden [STAGE ...]`."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from tests.golden.record import PLACE, case_names, differences, made_now, read_recorded, write_recorded

PLUGINS = Path(__file__).parents[2] / "plugins"


def main(asked: list[str]) -> None:
    """Record the cases that are asked for, or all; figures that differ no more than machines do stay as they are.

    What is written down of stages that no longer exist is removed, unless the bundled plugins are not there.
    """
    recorded = read_recorded() if PLACE.exists() else {}
    for name in asked or case_names():
        now, before = made_now(name), recorded.get(name)
        changes = differences(before.summary, now.summary) if before is not None else ["new"]
        recorded[name] = now if changes or before is None else replace(now, summary=before.summary)
        print(f"{name}: {'; '.join(changes) or 'as before'}", flush=True)
        names = case_names() if PLUGINS.is_dir() else list(recorded)
        write_recorded({name: one for name, one in recorded.items() if name in names})


if __name__ == "__main__":
    main(sys.argv[1:])
