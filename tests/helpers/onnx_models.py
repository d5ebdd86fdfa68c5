"""Real ONNX models for the tests of denoisers/onnx.py."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

Shape = Sequence[int | str]

NCHW = (1, 3, "height", "width")
NHWC = (1, "height", "width", 3)


def info(name: str, shape: Shape | None, dtype: int = TensorProto.FLOAT) -> onnx.ValueInfoProto:
    """Declare an input or an output; None declares no shape."""
    return helper.make_tensor_value_info(name, dtype, shape)


def save(path: Path, graph: onnx.GraphProto, metadata: dict[str, str] | None = None) -> Path:
    """Write a graph as a model."""
    proto = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(proto, metadata or {})
    onnx.save(proto, path)
    return path


def convolution(
    path: Path,
    shape: Shape = NCHW,
    *,
    name: str = "color",
    half: bool = False,
    metadata: dict[str, str] | None = None,
) -> Path:
    """Write a 1×1 convolution: the colour, plus twice the albedo, plus four times the normal."""
    nhwc = shape[1] not in (3, 6, 9)
    channels = int(shape[3] if nhwc else shape[1])
    element, dtype = (TensorProto.FLOAT16, np.float16) if half else (TensorProto.FLOAT, np.float32)
    kernel = np.concatenate([np.eye(3, dtype=dtype) * factor for factor in (1, 2, 4)], axis=1)
    weights = numpy_helper.from_array(kernel[:, :channels, None, None].copy(), "kernel")
    if nhwc:
        nodes = [
            helper.make_node("Transpose", [name], ["planes"], perm=[0, 3, 1, 2]),
            helper.make_node("Conv", ["planes", "kernel"], ["convolved"]),
            helper.make_node("Transpose", ["convolved"], ["out"], perm=[0, 2, 3, 1]),
        ]
        output = (*shape[:3], 3)
    else:
        nodes = [helper.make_node("Conv", [name, "kernel"], ["out"])]
        output = (shape[0], 3, *shape[2:])
    graph = helper.make_graph(nodes, "conv", [info(name, shape, element)], [info("out", output, element)], [weights])
    return save(path, graph, metadata)


def sum_of(path: Path, inputs: dict[str, Shape], output: Shape | None = NCHW) -> Path:
    """Write the sum of named inputs, each of its own layout, the result NCHW: colour + albedo + normal."""
    nodes, planes = [], []
    for name, shape in inputs.items():
        planes.append(f"{name} planes")
        order = [0, 1, 2, 3] if shape[1] == 3 else [0, 3, 1, 2]
        nodes.append(helper.make_node("Transpose", [name], [planes[-1]], perm=order))
    nodes.append(helper.make_node("Sum", planes, ["out"]))
    declared = [info(name, shape) for name, shape in inputs.items()]
    return save(path, helper.make_graph(nodes, "sum", declared, [info("out", output)]))
