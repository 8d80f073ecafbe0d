"""Names of images that a hostile file may state; none of them may name a file."""

from __future__ import annotations

from pathlib import Path

HOSTILE_NAMES = (
    "..",
    "../secret.png",
    "a/../../secret.png",
    "/secret.png",
    "//host/share/secret.png",
    "\\\\host\\share\\secret.png",
    "a\\..\\..\\secret.png",
    "C:secret.png",
    "C:/secret.png",
    "a/nul",
    "con.png",
    "e\x07.png",
    "e\x1b[2J.png",
)

LONG_NAMES = ("x" * 251 + ".png", "ü" * 125 + ".png", f"a/{'x' * 255}/b.png")
"""Names that file systems allow, but not those of results, which are longer."""


def contents(folder: Path) -> dict[str, bytes | None]:
    """Return all files and folders below a folder, and the bytes of the files."""
    found = sorted(folder.rglob("*"))
    return {str(path): path.read_bytes() if path.is_file() else None for path in found}
