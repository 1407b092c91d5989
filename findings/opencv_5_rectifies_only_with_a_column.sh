#!/usr/bin/env bash
# OpenCV 5 no longer rectifies with a translation of shape (3,).
#
# Seen with opencv-python-headless 5.0.0.93 and 4.12.0.88. A translation that was read from a file is mostly an
# array of three numbers, shape (3,). OpenCV 4 takes it for a column and cv2.stereoRectify works. OpenCV 5 has
# arrays of one dimension and takes it for a row: the same call fails inside a matrix product, with a message
# that names neither T nor its shape. Shape (3, 1) works in both, (1, 3) in neither.
#
# Output seen:
#   4.12.0: (3,) -84.0, (3, 1) -84.0, (1, 3) error
#   5.0.0: (3,) error, (3, 1) -84.0, (1, 3) error
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > rectify.py <<'PYTHON'
import cv2
import numpy as np

K = np.array([[700.0, 0, 640], [0, 700, 360], [0, 0, 1]])
said = []
for shape in ((3,), (3, 1), (1, 3)):
    T = np.array([-0.12, 0, 0]).reshape(shape)
    try:
        P2 = cv2.stereoRectify(K, np.zeros(5), K, np.zeros(5), (1280, 720), np.eye(3), T)[3]
        said.append(f"{shape} {P2[0, 3]:.1f}")
    except cv2.error as fault:
        assert "a_size.width == len" in str(fault), fault
        said.append(f"{shape} error")
print(f"{cv2.__version__}: {', '.join(said)}")
PYTHON
for version in 4.12.0.88 5.0.0.93; do
    python3 -m venv "venv$version"
    "venv$version/bin/pip" install --quiet "opencv-python-headless==$version"
    "venv$version/bin/python" rectify.py
done | tee seen
diff seen - <<'SEEN'
4.12.0: (3,) -84.0, (3, 1) -84.0, (1, 3) error
5.0.0: (3,) error, (3, 1) -84.0, (1, 3) error
SEEN
