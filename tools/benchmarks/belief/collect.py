"""Collect evidence of generated captures.

FILE receives one JSON line per capture with its placed cameras (`measuring.Measured`); captures that it has are not
measured again, so that an interrupted collection continues. Each round draws one capture of every family.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from tools.benchmarks.belief.families import FAMILIES, draw
from tools.benchmarks.belief.measuring import measure


def main() -> None:
    """Measure the captures that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--families", nargs="+", choices=list(FAMILIES), default=list(FAMILIES))
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=30)
    options = parser.parse_args()
    known = set()
    if options.file.is_file():
        known = {(row["family"], row["seed"]) for row in map(json.loads, options.file.read_text().splitlines())}
    for seed in range(options.first_seed, options.first_seed + options.rounds):
        for family in options.families:
            if (family, seed) in known:
                continue
            start = time.process_time()
            try:
                capture = draw(family, seed)
            except ValueError as error:  # the drawn place is too small for its cameras
                print(f"{family} {seed}: {error}", flush=True)
                continue
            drawn_s = time.process_time() - start
            rows, spent = measure(capture)
            line = {
                "family": family,
                "seed": seed,
                "views": len(capture.pictures),
                "cpu_s": {"drawn": drawn_s, **spent},
                "cameras": rows,
            }
            with options.file.open("a") as out:
                out.write(json.dumps(line) + "\n")
            right = sum(row["right"] for row in rows)
            silent = sum(not row["right"] and not row["doubted"] for row in rows)
            doubted = sum(row["right"] and row["doubted"] for row in rows)
            figures = f"{len(rows)} placed, {right} right, {doubted} of them doubted, {silent} wrong in silence"
            seconds = ", ".join(f"{key} {value:.1f} CPU-s" for key, value in line["cpu_s"].items())
            print(f"{family:11s} {seed:4d}  {len(capture.pictures):2d} views, {figures}; {seconds}", flush=True)
