"""What all tests share."""

from __future__ import annotations

import os

# A worker takes longer to start than most of the small runs in here take; tests of the executors name theirs.
os.environ.setdefault("PANO_MVS_EXECUTOR", "serial")
# PyVista takes seconds to start; the tests of its pictures name it.
os.environ.setdefault("PANO_MVS_RENDERER", "software")
# What whoever runs the tests has among their own plugins is no part of them.
os.environ["PANO_MVS_PLUGINS"] = ""
