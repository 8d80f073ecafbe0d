"""The Dockerfile, without docker: what it copies is there, and its steps give a program that runs."""

from __future__ import annotations

import fnmatch
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path

import pytest

from tests.docs.test_examples import parse

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
README = (ROOT / "README.md").read_text(encoding="utf-8")
KNOWN = {"FROM", "RUN", "COPY", "ENV", "WORKDIR", "ENTRYPOINT", "CMD"}


def instructions(text: str) -> list[tuple[str, str]]:
    """Return the instructions of a Dockerfile with their arguments."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", " ", "\n".join(lines)).splitlines()
    return [(name, rest) for name, _, rest in (line.partition(" ") for line in joined)]


STEPS = instructions((ROOT / "Dockerfile").read_text(encoding="utf-8"))


def only(name: str) -> str:
    """Return the argument of the only instruction with a name."""
    (found,) = [rest for each, rest in STEPS if each == name]
    return found


def copies() -> list[tuple[list[str], str]]:
    """Return the sources and the target of each COPY."""
    words = [shlex.split(rest) for name, rest in STEPS if name == "COPY"]
    return [(each[:-1], each[-1]) for each in words]


def pip_install() -> str:
    """Return the command that installs the package."""
    (found,) = [
        command
        for name, rest in STEPS
        if name == "RUN"
        for command in map(str.strip, rest.split("&&"))
        if command.startswith("pip install")
    ]
    return found


def test_the_image_has_a_python_that_the_package_supports() -> None:
    found = re.fullmatch(r"python:(3\.\d+)-slim", only("FROM"))
    assert found
    assert f"Programming Language :: Python :: {found[1]}" in PROJECT["classifiers"]


def test_all_instructions_are_known() -> None:
    assert {name for name, _ in STEPS} == KNOWN


def test_the_files_that_are_copied_are_there_and_not_ignored() -> None:
    patterns = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if line and not line.startswith("#")]
    for source in (source for sources, _ in copies() for source in sources):
        assert (ROOT / source).exists()
        ignored = False
        for pattern in patterns:
            if fnmatch.fnmatch(source, pattern.removeprefix("!")):
                ignored = not pattern.startswith("!")
        assert not ignored, source


def test_the_extras_exist() -> None:
    found = re.search(r"/src\[([\w,]+)\]", pip_install())
    assert found
    assert set(found[1].split(",")) <= set(PROJECT["optional-dependencies"])


def test_the_commands_of_the_readme_name_the_image_and_commands_of_the_program() -> None:
    found = re.search(r"<!-- docker -->\n```bash\n(.*?)```", README, re.DOTALL)
    assert found
    build, run = (shlex.split(line) for line in found[1].splitlines())
    image = build[build.index("--tag") + 1]
    mounted = [run[idx + 1].split(":")[1] for idx, word in enumerate(run) if word == "--volume"]
    assert set(mounted) == {only("WORKDIR"), "/cache"}
    assert "XDG_CACHE_HOME=/cache" in only("ENV").split()
    parse(run[run.index(image) + 1 :])


def test_the_entry_point_is_the_program() -> None:
    (program,) = json.loads(only("ENTRYPOINT"))
    assert program in PROJECT["scripts"]


@pytest.mark.slow
def test_the_steps_give_a_program_that_runs(tmp_path: Path) -> None:
    """Copies and installs as the Dockerfile does; the dependencies are those of the environment of the test."""
    source, work, cache = tmp_path / "src", tmp_path / "work", tmp_path / "cache"
    work.mkdir()
    for names, target in copies():
        place = Path(str(source) + target.removeprefix("/src"))
        for name in names:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, place, ignore=shutil.ignore_patterns("__pycache__", ".pano-mvs"))
            else:
                place.mkdir(parents=True, exist_ok=True)
                shutil.copy(ROOT / name, place)
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PANO_MVS_CACHE")}
    environment |= {"XDG_CACHE_HOME": str(cache), "MPLCONFIGDIR": str(cache / "matplotlib"), "COLUMNS": "200"}
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True, env=environment)
    scripts = tmp_path / "venv" / ("Scripts" if sys.platform == "win32" else "bin")
    paths = sysconfig.get_paths(vars={"base": str(tmp_path / "venv"), "platbase": str(tmp_path / "venv")})
    (Path(paths["purelib"]) / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"])
    command = shlex.split(pip_install().replace("/src", source.as_posix()))
    offline = ["--no-deps", "--no-build-isolation", "--no-index"]
    assert command[0] == "pip"
    pip: list[str | Path] = [sys.executable, "-m", "pip", "--python", scripts / "python", *command[1:], *offline]
    installed = subprocess.run(pip, env=environment, capture_output=True)
    assert installed.returncode == 0, installed.stdout + installed.stderr
    shutil.rmtree(source)

    def call(*arguments: str) -> str:
        program = scripts / json.loads(only("ENTRYPOINT"))[0]
        done = subprocess.run(
            [program, *arguments], cwd=work, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    assert re.search(r"\d+\.\d+", call("--version"))
    assert "run" in call(*json.loads(only("CMD")))
    call("run", "quickstart", "--until", "images")
    where = subprocess.run(
        [scripts / "python", "-c", "import pano_mvs; print(pano_mvs.__file__)"],
        cwd=work,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert Path(where.stdout.strip()).is_relative_to(tmp_path / "venv")


@pytest.mark.docker
def test_the_image_is_built_and_runs(tmp_path: Path) -> None:
    def docker(*arguments: str | Path) -> str:
        done = subprocess.run(["docker", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    docker("build", "--tag", "pano_mvs_test", ".")
    run = ("run", "--rm", "--user", f"{os.getuid()}:{os.getgid()}", "--volume", f"{tmp_path}:/work", "pano_mvs_test")
    assert re.search(r"\d+\.\d+", docker(*run, "--version"))
    docker(*run, "run", "quickstart", "--until", "images")
    assert (tmp_path / "out" / "quickstart" / "run.json").is_file()
