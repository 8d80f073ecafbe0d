"""The loader of the page's data, run by node with a page that loads nothing by itself."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pano_mvs_page
import pytest

LOADER = Path(pano_mvs_page.__file__).parent / "web" / "loader.js"
PAGE = """
const scripts = [];
globalThis.document = {
  createElement: () => ({ remove() {} }),
  head: { append: (script) => scripts.push(script) },
};
const said = [];
const ask = (key) => PanoMvs.load(key).then((value) => said.push(value), (error) => said.push(error.message));
"""


def said(steps: str) -> list[str]:
    """Return what the promises of `ask` gave, or why they were broken, in this order."""
    code = f"{LOADER.read_text()}\n{PAGE}\n{steps}\nsetTimeout(() => console.log(JSON.stringify(said)));"
    done = subprocess.run(["node", "-e", code], check=True, capture_output=True, text=True, timeout=60)
    found: list[str] = json.loads(done.stdout)
    return found


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ('ask("a"); PanoMvs.receive("a", "1"); scripts[0].onload();', ["1"]),
        ('PanoMvs.receive("a", "1"); ask("a"); ask("a");', ["1", "1"]),
        ('ask("a"); ask("a"); PanoMvs.receive("a", "1"); said.push(scripts.length);', [1, "1", "1"]),
        ('ask("a"); PanoMvs.receive("a", "1"); ask("a"); PanoMvs.receive("a", "2");', ["1", "2"]),
        (
            'ask("a"); PanoMvs.receive("a", "1"); ask("a"); scripts[0].onload(); PanoMvs.receive("a", "2");',
            ["1", "2"],
        ),
        ('ask("a"); ask("a"); scripts[0].onerror();', ["data/a.js is missing", "data/a.js is missing"]),
        ('ask("a"); scripts[0].onerror(); ask("a"); PanoMvs.receive("a", "1");', ["data/a.js is missing", "1"]),
        ('ask("a"); scripts[0].onload();', ["data/a.js is damaged"]),
        ('ask("a"); ask("b"); PanoMvs.receive("b", "2"); PanoMvs.receive("a", "1");', ["2", "1"]),
    ],
)
def test_each_promise_is_kept_or_broken(steps: str, expected: list[str]) -> None:
    """A piece of data that was asked for again while it was on its way never came to who had asked first."""
    assert said(steps) == expected
