"""Pose files that look right and are not."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.io.poses.files import read_poses

IDENTITY = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]


def views(**more: object) -> dict[str, object]:
    return {"views": [{"image": "a.png", "R": IDENTITY, "t": [0, 0, 0]}], **more}


def frames(matrix: object) -> dict[str, object]:
    frame = {"file_path": "a.png", "transform_matrix": matrix}
    return {"camera_model": "EQUIRECTANGULAR", "frames": [frame]}


def shots(**part: object) -> list[dict[str, object]]:
    return [{"cameras": {"c": {"projection_type": "spherical"}}, **part}]


SHOT = {"camera": "c", "rotation": [0, 0, 0], "translation": [0, 0, 0]}


@pytest.mark.parametrize(
    ("name", "data", "what"),
    [
        ("poses.json", views(metric="false"), "must be true or false"),
        ("transforms.json", frames([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]]), "transposed"),
        ("transforms.json", frames([[1, 0, 0, 10**400], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "4 × 4 numbers"),
        ("transforms.json", frames([[1, 0, 0, 1e308], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "not a valid pos"),
        ("reconstruction.json", shots(shots=3), "must be objects by name"),
        ("reconstruction.json", shots(shots={"a.png": {**SHOT, "camera": ["c"]}}), "projection_type is None"),
    ],
)
def test_traps_are_named(tmp_path: Path, name: str, data: object, what: str) -> None:
    (tmp_path / name).write_text(json.dumps(data))
    with pytest.raises(InputError, match=what) as caught:
        read_poses(tmp_path / name)
    assert name in str(caught.value)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"views": ' + "9" * 5000 + "}"])
def test_json_that_breaks_readers_is_an_input_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "poses.json").write_text(text)
    with pytest.raises(InputError, match=r"poses\.json"):
        read_poses(tmp_path / "poses.json")


def test_a_reconstruction_without_reference_is_not_metric(tmp_path: Path) -> None:
    path = tmp_path / "reconstruction.json"
    path.write_text(json.dumps(shots(shots={"a.png": SHOT})))
    assert not read_poses(path).metric
