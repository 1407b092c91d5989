"""Records grey pictures with librealsense's recorder, from a device of software:
``python librealsense.py PICTURES.npy FILE``, pictures (N, 2, H, W), a stamp an index.

Up to 2.57 the recorder writes a ROS 1 bag, from 2.58 on a ROS 2 database."""

import sys
import time

import numpy as np
import pyrealsense2 as rs

PERIOD_MS, FIRST_MS = 100, 1_700_000_000_000


def stream(sensor, index, width, height):
    """Of one eye."""
    lens = rs.intrinsics()
    lens.width, lens.height = width, height
    lens.fx = lens.fy = 132.4
    lens.ppx, lens.ppy = 160.5, 90.3
    lens.model, lens.coeffs = rs.distortion.none, [0.0] * 5
    made = rs.video_stream()
    made.type, made.index, made.uid = rs.stream.infrared, index, index
    made.width, made.height, made.fps, made.bpp = width, height, 1000 // PERIOD_MS, 1
    made.fmt, made.intrinsics = rs.format.y8, lens
    return sensor.add_video_stream(made).as_video_stream_profile()


def main(pictures, file):
    frames = np.load(pictures)
    height, width = frames.shape[2:]
    device = rs.software_device()
    sensor = device.add_sensor("Stereo Module")
    eyes = [stream(sensor, index, width, height) for index in (1, 2)]
    apart = rs.extrinsics()
    apart.rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]
    apart.translation = [-0.12, 0, 0]
    eyes[0].register_extrinsics_to(eyes[1], apart)
    recorder = rs.recorder(file, device)
    (recording,) = recorder.query_sensors()
    recording.open(eyes)
    recording.start(lambda frame: None)
    for number, pair in enumerate(frames):
        for eye, picture in zip(eyes, pair, strict=True):
            frame = rs.software_video_frame()
            frame.pixels, frame.stride, frame.bpp = np.ascontiguousarray(picture), width, 1
            frame.timestamp, frame.frame_number = FIRST_MS + number * PERIOD_MS, number + 1
            frame.domain, frame.profile = rs.timestamp_domain.global_time, eye
            sensor.on_video_frame(frame)
        time.sleep(PERIOD_MS / 1000)
    recording.stop()
    recording.close()
    recorder.pause()


main(*sys.argv[1:])
