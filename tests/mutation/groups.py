"""Which modules are mutated, and which tests have to notice: the one place to edit when files move."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Group:
    """Modules that one score is given for.

    Attributes:
        sources: glob patterns of the modules, from the root of the repository.
        tests: paths that pytest runs.
    """

    sources: tuple[str, ...]
    tests: tuple[str, ...]


def _engine(*names: str) -> tuple[str, ...]:
    return tuple(f"tests/engine/test_{name}.py" for name in names)


GROUPS = {
    "geometry": Group(("pano_mvs/geometry/*.py",), ("tests/geometry",)),
    "scene": Group(
        ("pano_mvs/scene/*.py",), ("tests/scene", "tests/io/images/test_exif.py", "tests/io/images/test_containers.py")
    ),
    "keys": Group(
        (
            "pano_mvs/core/digest.py",
            "pano_mvs/engine/code/*.py",
            "pano_mvs/engine/code/plugin_digest.py",
            "pano_mvs/engine/planning/resolve.py",
            "pano_mvs/engine/stages/stage_code.py",
            "pano_mvs/engine/planning/units.py",
        ),
        _engine(
            "digests", "plugin_digest", "code_digest", "code_summary", "code_reach", "stage_code", "resolve", "run"
        ),
    ),
    "store": Group(
        ("pano_mvs/engine/cache/store.py", "pano_mvs/engine/cache/blobs.py"),
        _engine("store", "store_promises", "hostile_store", "stat_cache", "layout"),
    ),
    "wiring": Group(("pano_mvs/engine/workflows/wiring.py",), _engine("wiring", "workflow", "run")),
    "scheduler": Group(
        ("pano_mvs/engine/running/scheduler.py",),
        _engine("scheduler", "run", "store", "hostile_store", "stat_cache", "changed_files"),
    ),
}
"""`__init__.py` is left out: it says what is public, which a test of its own checks."""
