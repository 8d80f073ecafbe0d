"""A network whose value of a pixel is its normalised grey: `python -m tests.algorithms.learned.grey_network` writes it.

Writing it needs the package onnx; reading it does not.
"""

from __future__ import annotations

import importlib
from pathlib import Path

GREY_NETWORK = Path(__file__).with_name("grey.onnx")


def write_network(path: Path, *, inputs: int = 1, channels: int = 3, keepdims: int = 0) -> None:
    """Write the network, or one that `depth.prior` has to refuse."""
    onnx = importlib.import_module("onnx")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    pictures = [helper.make_tensor_value_info(f"picture{n}", kind, [1, channels, "h", "w"]) for n in range(inputs)]
    grey = helper.make_tensor_value_info("grey", kind, None)
    mean = helper.make_node("ReduceMean", ["picture0"], ["grey"], axes=[1], keepdims=keepdims)
    graph = helper.make_graph([mean], "grey", pictures, [grey])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    path.write_bytes(model.SerializeToString())


if __name__ == "__main__":
    write_network(GREY_NETWORK)
    write_network(GREY_NETWORK.with_name("two_inputs.onnx"), inputs=2)
