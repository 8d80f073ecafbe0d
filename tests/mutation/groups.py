"""Which modules are mutated, and which tests have to notice: the one place to edit when files move."""

from dataclasses import dataclass

ENGINE_TESTS = ("tests/engine", "tests/core")


@dataclass(frozen=True)
class Group:
    """Modules that one score is given for.

    Attributes:
        sources: glob patterns of the modules, from the root of the repository.
        tests: paths that pytest runs.
    """

    sources: tuple[str, ...]
    tests: tuple[str, ...]


GROUPS = {
    "geometry": Group(("pano_mvs/geometry/*.py",), ("tests/geometry",)),
    "scene": Group(("pano_mvs/scene/*.py",), ("tests/scene", "tests/io")),
    "keys": Group(
        (
            "pano_mvs/core/digest.py",
            "pano_mvs/engine/code/*.py",
            "pano_mvs/engine/code_digest.py",
            "pano_mvs/engine/resolve.py",
            "pano_mvs/engine/stage_code.py",
            "pano_mvs/engine/units.py",
        ),
        ENGINE_TESTS,
    ),
    "store": Group(("pano_mvs/engine/store.py", "pano_mvs/engine/blobs.py"), ENGINE_TESTS),
    "wiring": Group(("pano_mvs/engine/wiring.py",), ENGINE_TESTS),
    "scheduler": Group(("pano_mvs/engine/scheduler.py",), ENGINE_TESTS),
}

SLOW_TESTS = (
    "tests/engine/test_dask.py",
    "tests/engine/test_large_plans.py",
    "tests/engine/test_resume.py",
    "tests/engine/test_workflow_hostile.py",
)
"""Left out: they take long, and test other modules or other processes."""
