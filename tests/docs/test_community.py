"""The files for people who use, cite or change the project name what exists."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

import pano_mvs
from tests.docs.test_examples import parse

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
TEMPLATES = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def loaded(path: Path) -> Any:
    return YAML(typ="safe").load(path)


def commands_of(path: Path) -> list[str]:
    """Return the `run:` commands of a GitHub workflow."""
    return [step["run"] for job in loaded(path)["jobs"].values() for step in job["steps"] if "run" in step]


@pytest.mark.parametrize("path", [path for path in TEMPLATES if path.stem != "config"], ids=lambda path: path.stem)
def test_issue_forms_have_what_github_requires(path: Path) -> None:
    form = loaded(path)
    assert {"name", "description", "body"} <= form.keys()
    ids = [part["id"] for part in form["body"] if part["type"] != "markdown"]
    assert len(ids) == len(set(ids)) > 0
    for part in form["body"]:
        assert part["type"] in ("markdown", "textarea", "input", "dropdown", "checkboxes")
        assert part["attributes"]["value" if part["type"] == "markdown" else "label"]
        for option in part["attributes"].get("options", ()):
            assert option["label"]


def test_there_is_a_form_for_each_kind_of_issue() -> None:
    assert {path.stem for path in TEMPLATES} == {"bug", "feature", "question", "config"}


@pytest.mark.parametrize("path", sorted((ROOT / ".github").rglob("*.[my]*")), ids=lambda path: path.name)
def test_pages_that_the_templates_link_to_exist(path: Path) -> None:
    for page in re.findall(r"blob/HEAD/([\w./-]+)", path.read_text(encoding="utf-8")):
        assert (ROOT / page).is_file()


def test_commands_that_the_templates_name_exist() -> None:
    for path in [*TEMPLATES, ROOT / "SECURITY.md"]:
        for mention in re.findall(r"`pano-mvs ([a-z][^`]*)`", path.read_text(encoding="utf-8")):
            try:
                parse(mention.split())
            except Exception as error:
                if "Missing" not in type(error).__name__:
                    raise


def test_the_checklist_of_pull_requests_has_the_commands_of_contributing() -> None:
    text = (ROOT / ".github" / "pull_request_template.md").read_text(encoding="utf-8")
    contributing = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    (check,) = re.findall(r"`(ruff check .*?)`", text)
    assert check in contributing


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_commands_of_the_workflows_are_those_of_the_documentation(path: Path) -> None:
    known = README + (ROOT / "CONTRIBUTING.md").read_text() + (ROOT / ".ci" / "run").read_text()
    for command in commands_of(path):
        for program in re.findall(r"^(?:NO_MKDOCS_2_WARNING=1 )?(mkdocs .*|\.ci/run)$", command, re.MULTILINE):
            assert program in known
    for job in loaded(path)["jobs"].values():
        assert job.get("timeout-minutes", 60) <= 120
        for step in job["steps"]:
            assert re.fullmatch(r"actions/[\w-]+@v\d+", step.get("uses", "actions/checkout@v4"))


def _systems(job: Any) -> list[str]:
    return job["strategy"]["matrix"]["os"] if "matrix" in job["runs-on"] else [job["runs-on"]]


@pytest.mark.skipif(sys.platform == "win32", reason="needs bash")
@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_jobs_have_what_github_requires_and_their_commands_are_valid(path: Path) -> None:
    for job in loaded(path)["jobs"].values():
        shell = job.get("defaults", {}).get("run", {}).get("shell", "")
        for step in job["steps"]:
            assert ("uses" in step) != ("run" in step)
            assert step.keys() <= {"uses", "run", "with", "shell", "name", "id", "env", "if"}
            if "run" not in step:
                continue
            windows = any(system.startswith("windows") for system in _systems(job))
            assert not windows or step.get("shell", shell) == "bash", "PowerShell knows neither && nor these patterns"
            assert subprocess.run(["bash", "-n", "-c", step["run"]], check=False).returncode == 0
        assert set(re.findall(r"matrix\.(\w+)", str(job))) <= job.get("strategy", {}).get("matrix", {}).keys()


def test_the_quickstart_runs_from_the_wheel_on_three_systems() -> None:
    job = loaded(ROOT / ".github/workflows/ci.yml")["jobs"]["wheel"]
    assert {system.partition("-")[0] for system in _systems(job)} == {"ubuntu", "macos", "windows"}
    commands = [step["run"] for step in job["steps"] if "run" in step]
    order = ["pip wheel", "pip install dist", "pano-mvs run quickstart", "0 units computed", "cloud.ply"]
    places = [next(idx for idx, command in enumerate(commands) if part in command) for part in order]
    assert places == sorted(places)


def test_the_site_is_published_from_where_it_is_built() -> None:
    upload = [step for step in loaded(ROOT / ".github/workflows/docs.yml")["jobs"]["build"]["steps"] if "with" in step]
    site = re.search(r"^site_dir: (\S+)", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert site
    assert upload[-1]["with"]["path"] == site[1]


def test_the_citation_is_that_of_this_version() -> None:
    citation = loaded(ROOT / "CITATION.cff")
    assert str(citation["version"]) == pano_mvs.__version__
    assert citation["cff-version"] == "1.2.0"
    assert f"version = {{{pano_mvs.__version__}}}" in README
    (paper,) = citation["references"]
    assert f"doi     = {{{paper['doi']}}}" in README
    assert f"title   = {{{paper['title']}}}" in README
    assert f"arXiv:{re.search(r'eprint  = .(.*).,', README)[1]}" in paper["identifiers"][0]["value"]  # type: ignore[index]


def test_the_script_of_ci_is_valid() -> None:
    if sys.platform == "win32":
        pytest.skip("needs bash")
    assert subprocess.run(["bash", "-n", ROOT / ".ci" / "run"], check=False).returncode == 0
