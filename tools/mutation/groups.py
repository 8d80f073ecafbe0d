"""Which modules are mutated, and which tests have to notice: the one place to edit when files move."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Group:
    """Modules that one score is given for.

    Attributes:
        sources: glob patterns of the modules, from the root of the repository.
        tests: paths that pytest runs.
        within: the class or function that is mutated; empty for whole modules.
    """

    sources: tuple[str, ...]
    tests: tuple[str, ...]
    within: str = ""


def _engine(*names: str) -> tuple[str, ...]:
    return tuple(f"tests/engine/{folder}/test_{name}.py" for folder, name in (name.split("/") for name in names))


_TESTS_OF_RUNS = _engine(
    "running/run_pass",
    "running/run",
    "running/changed_files",
    "cache/store",
    "cache/hostile_store",
    "cache/stat_cache",
)

GROUPS = {
    "geometry": Group(("pano_mvs/geometry/*.py",), ("tests/geometry",)),
    "scene": Group(
        ("pano_mvs/scene/*.py",),
        ("tests/scene", "tests/io/images/test_metadata.py", "tests/io/images/test_containers.py"),
    ),
    "keys": Group(
        (
            "pano_mvs/core/digest.py",
            "pano_mvs/engine/planning/unit_keys.py",
            "pano_mvs/engine/planning/units.py",
            "pano_mvs/engine/stages/stage_code.py",
        ),
        (
            "tests/core/test_digests.py",
            *_engine("stages/stage_code", "planning/unit_keys", "running/run"),
        ),
    ),
    "store": Group(
        ("pano_mvs/engine/cache/store.py", "pano_mvs/engine/cache/blobs.py"),
        _engine("cache/store", "cache/hostile_store", "cache/stat_cache"),
    ),
    "merged_stages": Group(
        ("pano_mvs/engine/workflows/merged_stages.py",), _engine("workflows/stage_groups", "workflows/workflow")
    ),
    "wiring": Group(
        ("pano_mvs/engine/workflows/wiring.py",), _engine("workflows/wiring", "workflows/workflow", "running/run")
    ),
    "run_pass": Group(("pano_mvs/engine/running/run.py",), _TESTS_OF_RUNS, within="RunPass"),
    "run": Group(
        ("pano_mvs/engine/running/run.py",),
        _TESTS_OF_RUNS,
        within="Run",
    ),
}
"""`__init__.py` is left out: it says what is public, which a test of its own checks."""
