"""The files of a shared page."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from pano_mvs.core.errors import StoreError, UsageError
from pano_mvs.core.files import remove_whole, write_given, write_text
from pano_mvs.core.paths import children, exists, is_file, is_folder

SCRIPTS = (
    "three.min.js",
    "loader.js",
    "pace.js",
    "cloud.js",
    "surface.js",
    "panorama.js",
    "walk.js",
    "measure.js",
    "map.js",
    "link.js",
    "rooms.js",
    "headset.js",
    "input.js",
    "page.js",
)
"""In the order in which the page loads them: classic scripts, since browsers refuse modules from file://."""

SINGLE_FILE = "page.html"
# Written first and never removed, so that an interrupted command can be repeated.
_MARK = "pano-mvs-page.txt"


def require_free(folder: Path, option: str = "") -> None:
    """Raise UsageError if a folder holds anything but an earlier page; the message begins with the option."""
    if exists(folder) and not is_folder(folder):
        raise UsageError(f"{option}{folder}: this is a file. Give a folder")
    if is_folder(folder) and any(children(folder)) and not is_file(folder / _MARK):
        raise UsageError(f"{option}{folder}: the folder is not empty and holds no earlier page. Give a new folder")


class PageFolder:
    """A folder with a page, to which data are added.

    Each piece of data is a script that hands its value to the page: opened from a disk, a page may load scripts from
    its own folder, but not read other files.
    """

    def __init__(self, folder: Path) -> None:
        """Make the folder, or empty one that holds an earlier page.

        Raises:
            UsageError: if the folder holds something else, or cannot be written.
            StoreError: if the disk is full.
        """
        require_free(folder, "--to ")
        for name in ("data", "index.html", SINGLE_FILE):
            remove_whole(folder / name)
        mark = "This folder was written by pano-mvs share, which may replace its files.\n"
        write_given(folder / _MARK, mark, f"--to {folder}")
        self.folder = folder
        # sizes of the pieces of data in bytes, by their paths below the folder, in the order of writing
        self.written: dict[str, int] = {}

    def put(self, key: str, value: Any) -> None:
        """Write one piece of data; `value` is anything that JSON can hold."""
        path = f"data/{key}.js"
        text = f"PanoMvs.receive({json.dumps(key)}, {_json(value)});\n"
        write_text(self.folder / path, text)
        self.written[path] = len(text.encode())

    def finish(self, title: str, *, max_single_file_bytes: int) -> Path | None:
        """Write the page itself; return the single file, or None if it would be larger than the limit."""
        for name in (*SCRIPTS, "page.css", "three.LICENSE.txt"):
            write_text(self.folder / name, _resource(name))
        write_text(self.folder / "index.html", _page(title, scripts=(), style=""))
        if sum(self.written.values()) > max_single_file_bytes:
            return None
        data = [_read(self.folder / path) for path in self.written]
        scripts = [_resource(name) for name in SCRIPTS]
        inline = [*scripts[:2], *data, *scripts[2:]]
        write_text(self.folder / SINGLE_FILE, _page(title, scripts=inline, style=_resource("page.css")))
        return self.folder / SINGLE_FILE


def _page(title: str, *, scripts: Sequence[str], style: str) -> str:
    """Return the HTML: with scripts and style inside, or else referring to the files beside it."""
    environment = Environment(
        loader=PackageLoader("pano_mvs_page", "web"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    return environment.get_template("index.html.j2").render(
        title=title,
        names=() if scripts else SCRIPTS,
        scripts=[Markup(text) for text in scripts],  # noqa: S704  # ours; _json leaves no "<" in data
        style=Markup(style),  # noqa: S704  # ours
        script_sources=Markup(" ".join(map(_source, scripts)) or "'self'"),  # noqa: S704  # digests
        style_source=Markup(_source(style) if style else "'self'"),  # noqa: S704  # a digest
    )


def _source(text: str) -> str:
    """Return the expression by which a content security policy allows one inline script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'"


def _json(value: Any) -> str:
    """Return JSON that can stand within a script: nothing in it closes the element or starts a comment."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _resource(name: str) -> str:
    return (files("pano_mvs_page") / "web" / name).read_text(encoding="utf-8")


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise StoreError(f"{path} cannot be read again: {error.strerror}. Run the same command again") from error
