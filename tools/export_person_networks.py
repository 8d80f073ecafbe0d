"""Convert MediaPipe's networks for people to the ONNX files in pano_mvs/algorithms/masks/models, and compare them.

Run it in an environment of its own, with a folder that holds the two TFLite files named in NOTICE.md there:

    python -m venv export && export/bin/pip install tflite onnx onnxruntime ai-edge-litert numpy
    export/bin/python tools/export_person_networks.py FOLDER OUTPUT_FOLDER

Each operator becomes one of ONNX opset 20, weights stay in half precision, and outputs that are not used are left out.
Prints the digests, which belong in pano_mvs/algorithms/masks/person_views.py, and the differences to LiteRT, and fails
if these are larger than LiteRT's rounding explains.
"""

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path
from typing import Any

import numpy as np

MISSING: str | None = None
try:
    import onnx
    import onnxruntime
    import tflite
    from ai_edge_litert.interpreter import Interpreter
    from onnx import TensorProto, helper, numpy_helper
except ModuleNotFoundError as error:
    MISSING = error.name

# Names of the outputs that are kept: in TFLite, and in ONNX.
NETWORKS = {
    "selfie_segmentation": {"activation_10": "probability"},
    "pose_landmark_lite": {"Identity_1": "presence", "Identity_2": "outline"},
}
LOGITS = "outline"
"""An output that gets a logistic function of its own."""

MAX_DIFFERENCE = 2e-2


class Converter:
    """A graph of TFLite, whose pictures are (1, height, width, channels), as one of ONNX, (1, channels, height, width).

    The input becomes (256, 256, 3) uint8.
    """

    def __init__(self, content: bytes) -> None:
        self.model = tflite.Model.GetRootAs(content, 0)
        self.graph = self.model.Subgraphs(0)
        self.nodes: list[onnx.NodeProto] = []
        self.weights: list[onnx.TensorProto] = []
        self.halves: dict[int, Any] = {}  # constants in half precision
        self.pads: dict[int, list[int]] = {}  # of values that are padded for the convolution that reads them
        floats = self.node("Cast", "picture", to=TensorProto.FLOAT)
        levels = self.node("Div", floats, self.weight(np.float32(255)))
        batch = self.node("Unsqueeze", levels, self.weight(np.zeros(1, np.int64)))
        self.values = {int(self.graph.Inputs(0)): self.node("Transpose", batch, perm=[0, 3, 1, 2])}
        kinds = {value: name for name, value in vars(tflite.BuiltinOperator).items() if isinstance(value, int)}
        for idx in range(self.graph.OperatorsLength()):
            operator = self.graph.Operators(idx)
            code = self.model.OperatorCodes(operator.OpcodeIndex())
            self.convert(operator, kinds[max(code.BuiltinCode(), code.DeprecatedBuiltinCode())])

    def node(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """Add an operator; return the name of its output."""
        self.nodes.append(helper.make_node(kind, list(inputs), [f"v{len(self.nodes)}"], **attributes))
        return str(self.nodes[-1].output[0])

    def weight(self, array: Any) -> str:
        """Store a constant; return the name of its values, which are in single precision if it is in half."""
        name = f"w{len(self.weights)}"
        self.weights.append(numpy_helper.from_array(np.asarray(array, order="C"), name))
        return self.node("Cast", name, to=TensorProto.FLOAT) if array.dtype == np.float16 else name

    def constant(self, at: int) -> Any:
        """Return the values of a constant tensor."""
        if at in self.halves:
            return self.halves[at]
        tensor = self.graph.Tensors(at)
        kinds = {tflite.TensorType.FLOAT16: np.float16, tflite.TensorType.INT32: np.int32}
        raw = self.model.Buffers(tensor.Buffer()).DataAsNumpy()
        return raw.view(kinds.get(tensor.Type(), np.float32)).reshape(tensor.ShapeAsNumpy())

    def options(self, operator: Any, kind: str) -> Any:
        """Return the attributes of an operator."""
        table, found = operator.BuiltinOptions(), getattr(tflite, f"{kind}Options")()
        found.Init(table.Bytes, table.Pos)
        return found

    def convert(self, operator: Any, kind: str) -> None:
        """Add what an operator of TFLite is in ONNX."""
        inputs, output = [int(at) for at in operator.InputsAsNumpy()], int(operator.Outputs(0))
        shape = self.graph.Tensors(output).ShapeAsNumpy().astype(np.int64)
        if kind == "DEQUANTIZE":
            self.halves[output] = self.constant(inputs[0])
            return
        first, activation = self.values[inputs[0]], tflite.ActivationFunctionType.NONE
        if kind in {"CONV_2D", "DEPTHWISE_CONV_2D"}:
            options = self.options(operator, "Conv2D" if kind == "CONV_2D" else "DepthwiseConv2D")
            filters = self.constant(inputs[1]).transpose((0, 3, 1, 2) if kind == "CONV_2D" else (3, 0, 1, 2))
            same = options.Padding() == tflite.Padding.SAME
            padding = {"auto_pad": "SAME_UPPER"} if same else {"pads": self.pads.get(inputs[0], [0, 0, 0, 0])}
            value = self.node(
                "Conv",
                first,
                self.weight(filters),
                self.weight(self.constant(inputs[2])),
                group=1 if kind == "CONV_2D" else len(filters),
                strides=[options.StrideH(), options.StrideW()],
                **padding,
            )
            activation = options.FusedActivationFunction()
        elif kind == "CUSTOM":  # Convolution2DTransposeBias, which doubles the size
            filters = self.constant(inputs[1]).transpose(3, 0, 1, 2)
            value = self.node(
                "ConvTranspose", first, self.weight(filters), self.weight(self.constant(inputs[2])), strides=[2, 2]
            )
        elif kind in {"AVERAGE_POOL_2D", "MAX_POOL_2D"}:
            options = self.options(operator, "Pool2D")
            value = self.node(
                "AveragePool" if kind == "AVERAGE_POOL_2D" else "MaxPool",
                first,
                kernel_shape=[options.FilterHeight(), options.FilterWidth()],
                strides=[options.StrideH(), options.StrideW()],
                auto_pad="SAME_UPPER" if options.Padding() == tflite.Padding.SAME else "VALID",
            )
        elif kind in {"ADD", "MUL"}:
            value = self.node(kind.title(), first, self.values[inputs[1]])
            activation = self.options(operator, kind.title()).FusedActivationFunction()
        elif kind == "PAD":
            self.pads[output] = [int(size) for size in self.constant(inputs[1])[1:3].T.ravel()]
            value = first
        elif kind == "RESIZE_BILINEAR":
            options = self.options(operator, "ResizeBilinear")
            aligned = "align_corners" if options.AlignCorners() else "asymmetric"
            value = self.node(
                "Resize",
                first,
                "",
                "",
                self.weight(shape[[0, 3, 1, 2]]),
                mode="linear",
                coordinate_transformation_mode="half_pixel" if options.HalfPixelCenters() else aligned,
            )
        elif kind == "RESHAPE":  # of a single pixel
            value = self.node("Reshape", first, self.weight(shape))
        else:
            value = self.node({"RELU": "Relu", "HARD_SWISH": "HardSwish", "LOGISTIC": "Sigmoid"}[kind], first)
        if activation == tflite.ActivationFunctionType.RELU:
            value = self.node("Relu", value)
        elif activation == tflite.ActivationFunctionType.RELU6:
            value = self.node("Clip", value, self.weight(np.float32(0)), self.weight(np.float32(6)))
        self.values[output] = value

    def save(self, path: Path, outputs: dict[str, str]) -> None:
        """Write the network with some outputs, their names in TFLite to those in ONNX."""
        ends = []
        for at in self.graph.OutputsAsNumpy():
            name = outputs.get(self.graph.Tensors(int(at)).Name().decode())
            if name is not None:
                sizes = [256, 256] if self.graph.Tensors(int(at)).ShapeAsNumpy()[-3:-1].tolist() == [256, 256] else [1]
                value = self.values[int(at)]
                value = self.node("Sigmoid", value) if name == LOGITS else value
                self.nodes.append(helper.make_node("Reshape", [value, self.weight(np.array(sizes))], [name]))
                ends.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, sizes))
        picture = helper.make_tensor_value_info("picture", TensorProto.UINT8, [256, 256, 3])
        used = {name for _, name in outputs.items()}
        kept = []
        for node in reversed(self.nodes):
            if used & set(node.output):
                kept.append(node)
                used |= set(node.input)
        weights = [weight for weight in self.weights if weight.name in used]
        graph = helper.make_graph(kept[::-1], path.stem, [picture], ends, weights)
        model = in_blocks(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9))
        onnx.checker.check_model(model, full_check=True)
        path.write_bytes(model.SerializeToString())


def in_blocks(model: Any) -> Any:
    """Return a network in which ONNX Runtime keeps 16 channels of a pixel together, which takes 30 % less time.

    Values of 8 channels get 8 more that are zero. ONNX Runtime merges Clip with a convolution only, so that one without
    effect follows the additions of large values. A convolution of 3 × 3 pixels to one channel becomes two: one of each
    channel by itself, and the sum of the channels.
    """
    graph = model.graph
    constants = {weight.name: weight for weight in graph.initializer}
    stored = {node.output[0]: node.input[0] for node in graph.node if node.op_type == "Cast"}
    shapes = {
        value.name: [axis.dim_value for axis in value.type.tensor_type.shape.dim]
        for value in onnx.shape_inference.infer_shapes(model).graph.value_info
    }
    added = {node.output[0] for node in graph.node if node.op_type == "Add"}
    nodes: list[onnx.NodeProto] = []

    def values(name: str) -> Any:
        return numpy_helper.to_array(constants[stored.get(name, name)])

    def replace(name: str, array: Any) -> None:
        constants[stored.get(name, name)].CopyFrom(numpy_helper.from_array(array, stored.get(name, name)))

    def convolution(inputs: list[str], output: str, filters: Any, **attributes: Any) -> None:
        graph.initializer.append(
            numpy_helper.from_array(np.asarray(filters, np.float32, order="C"), f"{output}_filters")
        )
        nodes.append(helper.make_node("Conv", [inputs[0], f"{output}_filters", *inputs[1:]], [output], **attributes))

    for node in graph.node:
        if node.op_type == "Resize" and (sizes := values(node.input[3])).tolist()[1] == 8:
            replace(node.input[3], np.where(sizes == 8, 16, sizes))
        if node.op_type == "Conv":
            group = next(attribute for attribute in node.attribute if attribute.name == "group")
            filters = values(node.input[1])
            padding = [(0, 8 if size == 8 else 0) for size in filters.shape]
            filters = np.pad(filters, padding)
            replace(node.input[1], filters)
            replace(node.input[2], np.pad(values(node.input[2]), padding[0]))
            group.i = 16 if group.i == 8 else group.i
            if len(filters) == 1 and filters.shape[2] == 3:
                channels, singly = filters.shape[1], f"{node.output[0]}_singly"
                attributes = {one.name: helper.get_attribute_value(one) for one in node.attribute}
                attributes["group"] = channels
                convolution([node.input[0]], singly, filters.transpose(1, 0, 2, 3), **attributes)
                convolution([singly, node.input[2]], node.output[0], np.ones((1, channels, 1, 1)))
                continue
        if node.op_type == "Clip" and node.input[0] in added and shapes[node.input[0]][2] >= 64:
            channels = max(16, shapes[node.input[0]][1])
            convolution([node.input[0]], f"{node.input[0]}_same", np.ones((channels, 1, 1, 1)), group=channels)
            node.input[0] = f"{node.input[0]}_same"
        nodes.append(node)
    del graph.node[:]
    graph.node.extend(nodes)
    return model


def differences(tflite_file: Path, onnx_file: Path, outputs: dict[str, str]) -> dict[str, float]:
    """Return the largest difference of each output over some pictures."""
    theirs = Interpreter(str(tflite_file))
    theirs.allocate_tensors()
    ours = onnxruntime.InferenceSession(onnx_file, providers=["CPUExecutionProvider"])
    rng, worst = np.random.default_rng(0), dict.fromkeys(outputs.values(), 0.0)
    for size in (2, 4, 8, 16, 32, 64, 128, 256):
        blocks = np.ones((256 // size, 256 // size, 1), np.uint8)
        picture = np.kron(rng.integers(0, 256, (size, size, 3), np.uint8), blocks)
        theirs.set_tensor(theirs.get_input_details()[0]["index"], picture[None].astype(np.float32) / 255)
        theirs.invoke()
        for end in theirs.get_output_details():
            if (name := outputs.get(end["name"])) is not None:
                expected = theirs.get_tensor(end["index"]).ravel()
                expected = 1 / (1 + np.exp(-np.clip(expected, -30, 30))) if name == LOGITS else expected
                found = ours.run([name], {"picture": picture})[0].ravel()
                worst[name] = max(worst[name], float(np.abs(found - expected).max()))
    return worst


def main() -> None:
    """Convert both networks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("output", type=Path)
    arguments = parser.parse_args()
    if MISSING is not None:
        parser.error(f"{MISSING} is not installed; see the top of this file")
    for name, outputs in NETWORKS.items():
        source, target = arguments.folder / f"{name}.tflite", arguments.output / f"{name}.onnx"
        Converter(source.read_bytes()).save(target, outputs)
        worst = differences(source, target, outputs)
        print(target.name, hashlib.sha256(target.read_bytes()).hexdigest(), target.stat().st_size, worst)
        if max(worst.values()) > MAX_DIFFERENCE:
            raise SystemExit(f"{name}: the outputs differ from those of LiteRT")


if __name__ == "__main__":
    main()
