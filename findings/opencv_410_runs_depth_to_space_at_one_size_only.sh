#!/usr/bin/env bash
# OpenCV 4.10 runs an ONNX network with DepthToSpace at the size it was written for and at no other.
#
# Seen with opencv-python-headless 4.10.0.84, 4.14.0.94, 5.0.0.93 and onnx 1.23.2 (which writes the file).
# A convolution and a DepthToSpace are written for 8 x 8 and run at 8 x 8 and 16 x 8. 4.10 fails at the
# second in computeShapeByReshapeMask: its reader turns DepthToSpace into reshapes of fixed sides. 4.14 and
# 5.0 run both. PyTorch writes pixel_shuffle as DepthToSpace. A transposed convolution whose weights are 0
# and 1 does the same, at any size, in all three.
#
# Output seen:
#   4.10.0: depth to space 8x8 yes, 16x8 no; transposed convolution 8x8 yes, 16x8 yes
#   4.14.0: depth to space 8x8 yes, 16x8 yes; transposed convolution 8x8 yes, 16x8 yes
#   5.0.0: depth to space 8x8 yes, 16x8 yes; transposed convolution 8x8 yes, 16x8 yes
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > make.py <<'PYTHON'
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

weights = numpy_helper.from_array(np.ones((4, 1, 1, 1), np.float32), "weights")
spread = numpy_helper.from_array(np.eye(4, dtype=np.float32).reshape(4, 1, 2, 2), "spread")
ends = {
    "shuffle": helper.make_node("DepthToSpace", ["y"], ["z"], blocksize=2),
    "transposed": helper.make_node(
        "ConvTranspose", ["y", "spread"], ["z"], kernel_shape=[2, 2], strides=[2, 2]
    ),
}
for name, end in ends.items():
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 1, 8, 8])
    z = helper.make_tensor_value_info("z", TensorProto.FLOAT, [1, 1, 16, 16])
    nodes = [helper.make_node("Conv", ["x", "weights"], ["y"], kernel_shape=[1, 1]), end]
    known = [weights, spread] if name == "transposed" else [weights]
    graph = helper.make_graph(nodes, name, [x], [z], known)
    opset = [helper.make_opsetid("", 18)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=9), f"{name}.onnx")
PYTHON
cat > run.py <<'PYTHON'
import cv2
import numpy as np

found = []
for name in ("shuffle", "transposed"):
    network = cv2.dnn.readNetFromONNX(f"{name}.onnx")
    for rows in (8, 16):
        network.setInput(np.ones((1, 1, rows, 8), np.float32))
        try:
            found.append(network.forward().shape == (1, 1, 2 * rows, 16))
        except cv2.error:
            found.append(False)
a, b, c, d = ("yes" if ran else "no" for ran in found)
print(f"{cv2.__version__}: depth to space 8x8 {a}, 16x8 {b}; transposed convolution 8x8 {c}, 16x8 {d}")
assert found == [True, not cv2.__version__.startswith("4.10"), True, True], found
PYTHON
python3 -m venv writer
writer/bin/pip install --quiet onnx==1.23.2 numpy
writer/bin/python make.py
for version in 4.10.0.84 4.14.0.94 5.0.0.93; do
    python3 -m venv --clear reader
    reader/bin/pip install --quiet "opencv-python-headless==$version" numpy
    reader/bin/python run.py 2> messages || { cat messages >&2; exit 1; }
done
