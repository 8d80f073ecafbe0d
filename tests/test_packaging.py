"""What a wheel holds besides the code."""

import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.skipif(not (ROOT / "workflows").is_dir(), reason="not in a checkout")
def test_the_wheel_has_all_presets_and_samples_and_no_cache_of_theirs() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    included = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    shipped = {
        "workflows/samples",
        "workflows/groups",
        *(f"workflows/{path.name}" for path in (ROOT / "workflows").glob("*.yaml")),
    }
    assert included == {name: f"pano_mvs/{name}" for name in shipped}
