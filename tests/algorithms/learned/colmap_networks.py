"""Small networks with the inputs and outputs of COLMAP's files: `python -m tests.algorithms.learned.colmap_networks`.

Their names, types, axes and units are those that COLMAP 4 checks and uses (src/colmap/feature/aliked.cc and
onnx_matchers.cc). The first finds the maxima of a random filter, and describes them by 128 others; the second
matches each key point with the most similar one. Writing them needs the package onnx; reading them does not.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np

EXTRACTOR = Path(__file__).with_name("colmap_extractor.onnx")
MATCHER = Path(__file__).with_name("colmap_matcher.onnx")
_AXES = {"image": [1, 3, "h", "w"], "max_keypoints": [], "min_score": []}
_FOUND = {"keypoints": [1, "k", 2], "descriptors": [1, "k", 128], "scores": [1, "k"]}
_PAIR: dict[str, list[Any]] = {
    "kpts0": [1, "m", 2],
    "kpts1": [1, "n", 2],
    "desc0": [1, "m", 128],
    "desc1": [1, "n", 128],
    "image_size0": [1, 2],
    "image_size1": [1, 2],
}


def write_extractor(path: Path, *, width: int = 128) -> None:
    """Write the network that finds key points, with descriptors of `width` numbers."""
    onnx = importlib.import_module("onnx")
    filters = np.random.default_rng(3).standard_normal((width, 3, 9, 9)).astype(np.float16)
    filters -= filters.mean(axis=(2, 3), keepdims=True)
    constants = {
        "filters": filters,
        "one": np.array([1], np.int64),
        "zero": np.array([0], np.int64),
        "rows": np.array([2], np.int64),
        "back": np.array([1, 0], np.int64),
        "two": np.array(2, np.float32),
        "unit": np.array(1, np.float32),
        "detector": (filters[:1] / 9).astype(np.float32),
    }
    steps: list[tuple[str, str, str, dict[str, Any]]] = [
        ("Conv", "image detector", "signed", {"pads": [4] * 4}),
        ("Abs", "signed", "bright", {}),
        ("MaxPool", "bright", "around", {"kernel_shape": [9, 9], "pads": [4] * 4, "strides": [1, 1]}),
        ("Equal", "bright around", "peak", {}),
        ("Greater", "bright min_score", "strong", {}),
        ("And", "peak strong", "chosen", {}),
        ("NonZero", "chosen", "four", {}),
        ("Slice", "four rows last", "yx", {}),
        ("Transpose", "yx", "places", {"perm": [1, 0]}),
        ("Squeeze", "bright leading", "map", {}),
        ("GatherND", "map places", "all_scores", {}),
        ("Shape", "all_scores", "count", {}),
        ("Unsqueeze", "max_keypoints zero", "most", {}),
        ("Min", "count most", "number", {}),
        ("TopK", "all_scores number", "best order", {"axis": 0}),
        ("Gather", "places order", "sorted", {"axis": 0}),
        ("Gather", "sorted back", "xy", {"axis": 1}),
        ("Cast", "xy", "pixels", {"to": 1}),
        ("Shape", "image", "size", {"start": 2}),
        ("Gather", "size back", "wh", {"axis": 0}),
        ("Cast", "wh", "extent", {"to": 1}),
        ("Sub", "extent unit", "steps", {}),
        ("Mul", "pixels two", "doubled", {}),
        ("Div", "doubled steps", "share", {}),
        ("Sub", "share unit", "normal", {}),
        ("Unsqueeze", "normal zero", "keypoints", {}),
        ("Cast", "filters", "weights", {"to": 1}),
        ("Conv", "image weights", "answers", {"pads": [4] * 4}),
        ("Transpose", "answers", "by_pixel", {"perm": [0, 2, 3, 1]}),
        ("Squeeze", "by_pixel zero", "grid", {}),
        ("GatherND", "grid sorted", "taken", {}),
        ("LpNormalization", "taken", "normed", {"axis": 1, "p": 2}),
        ("Unsqueeze", "normed zero", "descriptors", {}),
        ("Unsqueeze", "best zero", "scores", {}),
    ]
    constants |= {"last": np.array([4], np.int64), "leading": np.array([0, 1], np.int64)}
    found = {**_FOUND, "descriptors": [1, "k", width]}
    types = {"max_keypoints": onnx.TensorProto.INT64}
    _write(path, steps, constants, ends=(_AXES, found), types=types)


def write_matcher(path: Path) -> None:
    """Write the network that matches the key points of two pictures."""
    constants = {"zero": np.array([0], np.int64), "leading": np.array([0], np.int64)}
    steps: list[tuple[str, str, str, dict[str, Any]]] = [
        ("Transpose", "desc1", "turned", {"perm": [0, 2, 1]}),
        ("MatMul", "desc0 turned", "similar", {}),
        ("ArgMax", "similar", "nearest", {"axis": 2, "keepdims": 0}),
        ("Squeeze", "nearest zero", "matches0", {}),
        ("ReduceMax", "similar", "highest", {"axes": [2], "keepdims": 0}),
        ("Squeeze", "highest leading", "mscores0", {}),
    ]
    onnx = importlib.import_module("onnx")
    outputs = {"matches0": ["m"], "mscores0": ["m"]}
    _write(path, steps, constants, ends=(_PAIR, outputs), types={"matches0": onnx.TensorProto.INT64})


def _write(
    path: Path,
    steps: list[tuple[str, str, str, dict[str, Any]]],
    constants: dict[str, Any],
    *,
    ends: tuple[dict[str, list[Any]], dict[str, list[Any]]],
    types: dict[str, int],
) -> None:
    onnx = importlib.import_module("onnx")
    helper = onnx.helper
    nodes = [helper.make_node(name, given.split(), made.split(), **settings) for name, given, made, settings in steps]
    inputs, outputs = (
        [
            helper.make_tensor_value_info(name, types.get(name, onnx.TensorProto.FLOAT), axes)
            for name, axes in one.items()
        ]
        for one in ends
    )
    weights = [onnx.numpy_helper.from_array(values, name) for name, values in constants.items()]
    graph = helper.make_graph(nodes, path.stem, inputs, outputs, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 15)], ir_version=8)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())


if __name__ == "__main__":
    write_extractor(EXTRACTOR)
    write_matcher(MATCHER)
