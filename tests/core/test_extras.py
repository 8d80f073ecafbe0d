"""A library of an extra is imported when it is used; without it, the message names the remedy."""

from __future__ import annotations

import json.decoder
import re
import sys

import pytest

from pano_mvs.core.errors import UsageError
from pano_mvs.core.extras import import_extra


def test_module_is_returned() -> None:
    assert import_extra("json.decoder", "--json", "json") is json.decoder


def test_missing_library_is_refused_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rocrate.rocrate", None)
    with pytest.raises(UsageError, match=re.escape("pano-mvs crate needs rocrate: pip install 'pano-mvs[crate]'")):
        import_extra("rocrate.rocrate", "pano-mvs crate", "crate")
