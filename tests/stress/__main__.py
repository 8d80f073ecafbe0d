"""`python -m tests.stress NAME [options]`: run a script of this folder, such as `faults`; see `tests.benchmarks`."""

import sys

from tests.benchmarks.__main__ import run

if __name__ == "__main__":
    run(f"stress.{sys.argv[1]}", sys.argv[2:])
