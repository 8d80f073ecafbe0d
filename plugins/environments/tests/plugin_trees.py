"""Source trees of plugins and libraries, which pip builds without a network: each brings its own build backend."""

from __future__ import annotations

from pathlib import Path

BACKEND = """
import base64, hashlib, pathlib, tomllib, zipfile

PROJECT = tomllib.loads(pathlib.Path("pyproject.toml").read_text(encoding="utf-8"))["project"]


def build_wheel(wheel_directory, config_settings=None, metadata_directory=None):
    stem = f"{PROJECT['name'].replace('-', '_')}-{PROJECT['version']}"
    needed = "".join(f"Requires-Dist: {one}\\n" for one in PROJECT.get("dependencies", ()))
    info = f"{stem}.dist-info"
    known = f"Metadata-Version: 2.1\\nName: {PROJECT['name']}\\nVersion: {PROJECT['version']}\\n"
    files = {
        f"{info}/METADATA": known + needed,
        f"{info}/WHEEL": "Wheel-Version: 1.0\\nGenerator: test\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n",
        f"{info}/entry_points.txt": "\\n".join(
            line
            for group, entries in PROJECT.get("entry-points", {}).items()
            for line in (f"[{group}]", *(f"{name} = {value}" for name, value in entries.items()))
        ),
    }
    for path in sorted(pathlib.Path(".").glob("*/*.py")):
        files[path.as_posix()] = path.read_text(encoding="utf-8")
    lines = []
    name = f"{stem}-py3-none-any.whl"
    with zipfile.ZipFile(pathlib.Path(wheel_directory, name), "w") as wheel:
        for path, text in files.items():
            digest = base64.urlsafe_b64encode(hashlib.sha256(text.encode()).digest()).rstrip(b"=").decode()
            lines.append(f"{path},sha256={digest},{len(text.encode())}")
            wheel.writestr(path, text)
        wheel.writestr(f"{info}/RECORD", "\\n".join([*lines, f"{info}/RECORD,,"]) + "\\n")
    return name
"""

STAGE = '''
"""A plugin that needs a version of a library."""

import shared_lib
from pydantic import Field, field_validator

from pano_mvs.api import Context, Each, Files, InputError, Panorama, Params, stage


class {title}Params(Params):
    """Settings."""

    text: str = Field(default="seen", description="what is written")
    times: int = Field(default=1, ge=1, le=9, description="how often")

    @field_validator("text")
    @classmethod
    def _short(cls, text: str) -> str:
        if len(text) > 20:
            raise ValueError("must be short")
        return text


@stage("export.{name}")
def {name}(panorama: Each[Panorama], params: {title}Params, ctx: Context) -> Files:
    """Write which version of the library was used."""
    if params.text == "bad":
        raise InputError("photos/bad.jpg: cannot be used. Remove it")
    ctx.metric("major", shared_lib.MAJOR)
    ctx.note("written by version " + shared_lib.VERSION)
    path = ctx.scratch / "seen.txt"
    path.write_text(params.text * params.times + " by " + shared_lib.VERSION)
    return Files({{"{name}/{{item}}.txt": path}})
'''


def write_project(
    folder: Path,
    name: str,
    version: str = "1.0",
    *,
    text: str,
    dependencies: tuple[str, ...] = (),
    more: str = "",
) -> Path:
    """Write the source tree of a distribution with one package, and return its folder.

    Args:
        text: of its package.
        more: further tables of its pyproject.toml.
    """
    package = folder / name.replace("-", "_")
    package.mkdir(parents=True, exist_ok=True)
    (package / "__init__.py").write_text(text)
    (folder / "backend.py").write_text(BACKEND)
    (folder / "pyproject.toml").write_text(
        f'[build-system]\nrequires = []\nbuild-backend = "backend"\nbackend-path = ["."]\n\n'
        f'[project]\nname = "{name}"\nversion = "{version}"\ndependencies = {list(dependencies)!r}\n{more}'
    )
    return folder


def write_library(folder: Path, version: str) -> Path:
    """Write the library `shared-lib` in a version, and return its folder."""
    text = f"VERSION = {version!r}\nMAJOR = {version[0]}\n"
    return write_project(folder, "shared-lib", version, text=text)


def write_plugin(
    folder: Path, name: str, library: Path | None, *, environment: str = "overlay", text: str = "", more: str = ""
) -> Path:
    """Write a plugin with the stage `export.NAME`, which needs a library, and return its folder."""
    needed = ("pano-mvs>=0.1", *([f"shared-lib @ {library.as_uri()}"] if library else []))
    asks = f'\n[tool.pano_mvs]\nenvironment = "{environment}"\n' if environment else ""
    offered = f'\n[project.entry-points."pano_mvs.plugins"]\n{name} = "{name}"\n'
    shown = text or STAGE.format(name=name, title=name.capitalize())
    return write_project(folder, name, text=shown, dependencies=needed, more=f"{offered}{more}{asks}")
