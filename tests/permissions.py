"""Let permissions hold in a test although the suite runs as root, who may otherwise read and write everything."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

_VERSION = 0x20080522  # of the structures that Linux's capget and capset take
_IGNORES_PERMISSIONS = 1 << 1 | 1 << 2  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
_DROP_FROM_BOUNDS = 24  # PR_CAPBSET_DROP


class _Header(ctypes.Structure):
    _fields_ = (("version", ctypes.c_uint32), ("process", ctypes.c_int))


class _Set(ctypes.Structure):
    _fields_ = (("effective", ctypes.c_uint32), ("permitted", ctypes.c_uint32), ("inheritable", ctypes.c_uint32))


@contextmanager
def permissions_hold() -> Iterator[None]:
    """Take from this thread, while the context lasts, root's right to pass over permissions.

    Whoever is not root needs nothing. Where root keeps the right, as on systems other than Linux, the test is skipped.
    """
    if os.name != "posix":
        pytest.skip("permissions as POSIX has them")
    if os.geteuid() != 0:
        yield
        return
    if not sys.platform.startswith("linux"):
        pytest.skip("root passes over permissions")
    before = _effective()
    _set_effective(before & ~_IGNORES_PERMISSIONS)
    try:
        yield
    finally:
        _set_effective(before)


def drop_right_to_ignore_permissions() -> None:
    """Take the right for good from this process and those that it starts: for `preexec_fn` of subprocess."""
    if os.geteuid() == 0 and sys.platform.startswith("linux"):
        for capability in (1, 2):
            _libc().prctl(_DROP_FROM_BOUNDS, capability, 0, 0, 0)
        _set_effective(_effective() & ~_IGNORES_PERMISSIONS)


def _libc() -> Any:
    return ctypes.CDLL(None, use_errno=True)


def _sets() -> Any:
    found = (_Set * 2)()
    if _libc().capget(ctypes.byref(_Header(_VERSION, 0)), found):
        pytest.skip("capabilities cannot be read here")
    return found


def _effective() -> int:
    return int(_sets()[0].effective)


def _set_effective(effective: int) -> None:
    wanted = _sets()
    wanted[0].effective = effective
    if _libc().capset(ctypes.byref(_Header(_VERSION, 0)), wanted):
        pytest.skip("capabilities cannot be set here")
