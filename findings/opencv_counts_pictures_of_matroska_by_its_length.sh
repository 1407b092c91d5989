#!/usr/bin/env bash
# OpenCV's number of pictures of a Matroska file is its length times its declared rate, not a count.
#
# Seen with opencv-python-headless 5.0.0.93 and PyAV 18.1.0 (which writes the files). A valid file of six
# pictures 33 ms apart in a stream declared 10/s "has" 3 pictures; six pictures 200 ms apart in one declared
# 30/s "have" 31. Both give six pictures when they are read. The same pictures in MP4 count 6.
# Recorders declare a rate once and write what comes: a reader that trusts CAP_PROP_FRAME_COUNT loses half of
# such a recording or waits for pictures that are not there.
#
# Output seen:
#   mkv, 10/s declared, 33 ms apart: claims 3, holds 6
#   mkv, 30/s declared, 200 ms apart: claims 31, holds 6
#   mp4, 10/s declared, 33 ms apart: claims 6, holds 6
#   mp4, 30/s declared, 200 ms apart: claims 6, holds 6
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet opencv-python-headless==5.0.0.93 av==18.1.0 numpy
cat > count.py <<'PYTHON'
from fractions import Fraction

import av
import cv2
import numpy as np

found = []
for suffix in ("mkv", "mp4"):
    for rate, gap_ms in ((10, 33), (30, 200)):
        path = f"{suffix}{rate}.{suffix}"
        with av.open(path, "w") as container:
            stream = container.add_stream("mpeg4", rate=rate)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
            for number in range(6):
                image = np.full((48, 64, 3), 40 * number, np.uint8)
                frame = av.VideoFrame.from_ndarray(image, format="bgr24")
                frame.pts, frame.time_base = gap_ms * number, Fraction(1, 1000)
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
        capture = cv2.VideoCapture(path)
        claim, count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0
        while capture.grab():
            count += 1
        print(f"{suffix}, {rate}/s declared, {gap_ms} ms apart: claims {claim}, holds {count}")
        found.append((claim, count))
assert found == [(3, 6), (31, 6), (6, 6), (6, 6)], found
PYTHON
venv/bin/python count.py
