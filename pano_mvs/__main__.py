"""`python -m pano_mvs` is `pano-mvs`."""

import os
import sys

# Python puts the current folder first: a json.py among somebody's pictures is not ours to run.
if not sys.flags.safe_path and sys.path and sys.path[0] in ("", os.getcwd()):  # noqa: PTH109  # as Python writes it
    del sys.path[0]

from pano_mvs.cli.app import main

if __name__ == "__main__":
    main()
