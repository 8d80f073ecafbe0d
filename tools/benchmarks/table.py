"""Tables as Markdown, for all benchmarks."""

from __future__ import annotations

from collections.abc import Iterable


def print_table(columns: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Print a table, and each row as soon as it is known."""
    columns = list(columns)
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|", flush=True)
    for row in rows:
        print(f"| {' | '.join(map(str, row))} |", flush=True)
