"""Records grey pictures with Foxglove's SDK as MCAP: ``python foxglove_sdk.py PICTURES.npy FILE``,
pictures (N, 2, H, W), the frame's stamp from its place."""

import sys

import foxglove
import numpy as np
from foxglove.channels import RawImageChannel
from foxglove.messages import RawImage, Timestamp

FIRST_NS, PERIOD_NS = 1_700_000_000_000_000_000, 100_000_000


def main(pictures, file):
    frames = np.load(pictures)
    height, width = frames.shape[2:]
    with foxglove.open_mcap(file):
        channels = [RawImageChannel(f"/{eye}/image") for eye in ("left", "right")]
        for number, pair in enumerate(frames):
            stamp = FIRST_NS + number * PERIOD_NS
            for channel, picture in zip(channels, pair, strict=True):
                image = RawImage(
                    timestamp=Timestamp(*divmod(stamp, 10**9)), frame_id="camera", width=width,
                    height=height, encoding="mono8", step=width, data=picture.tobytes(),
                )  # fmt: skip
                channel.log(image, log_time=stamp)


main(*sys.argv[1:])
