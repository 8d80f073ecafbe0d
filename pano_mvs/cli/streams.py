"""Streams that are heard although a unit's output is being captured."""

from __future__ import annotations

import os
from typing import TextIO


def apart(stream: TextIO) -> TextIO:
    """Return a stream to where another one leads now, wherever its descriptor is turned to later.

    A stream that has no descriptor, such as a test's, is returned as it is: nobody turns it.
    """
    try:
        stream.flush()
        descriptor = os.dup(stream.fileno())
    except (OSError, ValueError, AttributeError):
        return stream
    return os.fdopen(descriptor, "w", encoding=stream.encoding, errors="replace", buffering=1)
