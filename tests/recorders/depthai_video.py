"""Records pictures of both eyes beside each other with depthai's RecordVideo, without a device:
``python depthai_video.py PICTURES.npy FILE``, pictures (N, 2, H, W).

Frames of the host are taken raw, into .mkv or .avi, and stored without loss (FFV1)."""

import sys
import time
from datetime import timedelta

import depthai as dai
import numpy as np


def main(pictures, file):
    frames = np.load(pictures)
    with dai.Pipeline(False) as pipeline:
        recorder = pipeline.create(dai.node.RecordVideo)
        recorder.setRecordVideoFile(file)
        recorder.setFps(10)
        queue = recorder.input.createInputQueue(len(frames), True)
        pipeline.start()
        for number, pair in enumerate(frames):
            both = np.repeat(np.hstack(pair)[..., None], 3, axis=2)
            frame = dai.ImgFrame()
            frame.setCvFrame(both, dai.ImgFrame.Type.BGR888i)
            frame.setSequenceNum(number)
            frame.setTimestamp(timedelta(milliseconds=100 * number))
            queue.send(frame)
            time.sleep(0.1)
        time.sleep(2)
        pipeline.stop()


main(*sys.argv[1:])
