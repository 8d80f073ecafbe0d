"""Reuse the images and figures of an earlier page whose inputs are the same.

Each image has a key: the digest of its inputs. The figures are used as they are, if they have the digest that is
written with them: a page whose figures were edited has none.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import UsageError
from pano_mvs.results.pictures import Picture

_DIGEST = "digest"
_PICTURE = re.compile(
    r'<img data-key="([0-9a-z.]{1,80})" src="(data:image/jpeg;base64,[A-Za-z0-9+/=]+)" width="(\d{1,5})" '
    r'height="(\d{1,5})"'
)
_FACTS = re.compile(r'<script type="application/json" id="facts">([^<]*)</script>')


class EarlierPage:
    """Images and figures of an earlier page by key, and those that the next page keeps."""

    def __init__(self, pictures: Mapping[str, Picture] | None = None, facts: Mapping[str, Any] | None = None) -> None:
        self._pictures = dict(pictures or {})
        self._facts = dict(facts or {})
        self.facts: dict[str, Any] = {}

    @staticmethod
    def of_file(path: Path) -> EarlierPage:
        """Return the images and figures of a page; nothing if there is no page, or another program wrote it."""
        try:
            text = path.read_text(encoding="utf-8") if path.stat().st_size <= 100_000_000 else ""
        except (OSError, UnicodeDecodeError):
            return EarlierPage()
        pictures = {
            key: Picture(uri, (int(height), int(width)), key) for key, uri, width, height in _PICTURE.findall(text)
        }
        return EarlierPage(pictures, _facts(text))

    def picture(self, key: str) -> Picture | None:
        """Return an image, or None if it was not kept."""
        return self._pictures.get(key)

    def fact(self, key: str) -> Any:
        """Return figures and keep them for the next page; None if they were not kept."""
        if key in self._facts:
            self.facts[key] = self._facts[key]
        return self._facts.get(key)

    def keep(self, key: str, fact: Any) -> None:
        """Keep figures for the next page."""
        self.facts[key] = fact

    def signed_facts(self) -> dict[str, Any]:
        """Return the figures that are kept, with their digest."""
        return {**self.facts, _DIGEST: digest_from_value(self.facts)} if self.facts else {}


def _facts(text: str) -> dict[str, Any]:
    found = _FACTS.search(text)
    try:
        facts = json.loads(found[1]) if found else {}
        digest = facts.pop(_DIGEST, "")
        return facts if digest == digest_from_value(facts) else {}
    except (ValueError, RecursionError, TypeError, AttributeError, UsageError):
        return {}
