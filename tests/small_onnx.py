"""A file in the form of an exported network, with a mean in its place."""

import json
from pathlib import Path

import onnx
from onnx import TensorProto, helper

HEIGHT, WIDTH = 6, 9


def write(
    path: str | Path, *, metadata=None, image=("batch", 3, HEIGHT, WIDTH), names=("image", "disparity"), kind=TensorProto.FLOAT, pool=1
):
    """A graph in the form of an exported one: the mean of the channels, plus one, instead of a network."""
    rows, columns = ((size // pool if isinstance(size, int) else size) for size in image[2:])
    inputs = [helper.make_tensor_value_info(names[0], kind, image)]
    outputs = [helper.make_tensor_value_info(names[1], kind, (image[0], 1, rows, columns))]
    average = {"kernel_shape": [pool, pool], "strides": [pool, pool]}
    nodes = [
        helper.make_node("AveragePool" if pool > 1 else "Identity", [names[0]], ["small"], **(average if pool > 1 else {})),
        helper.make_node("ReduceMean", ["small", "axes"], ["mean"]),
        helper.make_node("Add", ["mean", "one"], [names[1]]),
    ]
    constants = [helper.make_tensor("axes", TensorProto.INT64, [1], [1]), helper.make_tensor("one", kind, [1], [1.0])]
    graph = helper.make_graph(nodes, "test", inputs, outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    card = json.dumps({"network": "lr" if pool == 3 else "dual"})
    helper.set_model_props(model, {"hr_size": json.dumps([HEIGHT, WIDTH]), "card": card} if metadata is None else metadata)
    onnx.save(model, path)
    return path
