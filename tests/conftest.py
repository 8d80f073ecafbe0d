"""What all tests share."""

from __future__ import annotations

import os

# A worker takes longer to start than most of the small runs in here take; tests of the executors name theirs.
os.environ.setdefault("PANO_MVS_EXECUTOR", "serial")
