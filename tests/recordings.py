"""Writers of small recordings for tests: SVO2 files, and Matroska and MP4 videos as real tools
write them."""

import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

SVO_MAGIC = 0x5C002C00


def access_units(
    images: Sequence[np.ndarray], codec: str = "libx264rgb", gop: int = 1
) -> list[bytes]:
    """Lossless access units (Annex B) of BGR images, each with parameter sets where it is a key
    frame."""
    import av

    context = av.CodecContext.create(codec, "w")
    context.height, context.width = images[0].shape[:2]
    context.pix_fmt, context.time_base = "bgr24", Fraction(1, 30)
    context.options = {
        "qp": "0",
        "preset": "ultrafast",
        "tune": "zerolatency",
        "g": str(gop),
        "bf": "0",
    }
    units: list[bytes] = []
    for number, image in enumerate(images):
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="bgr24")
        frame.pts = number
        units += [bytes(packet) for packet in context.encode(frame)]
    units += [bytes(packet) for packet in context.encode(None)]
    assert len(units) == len(images)
    return units


def write_svo2(
    path: Path, pairs: Sequence[tuple[np.ndarray, np.ndarray]], stamps: Sequence[int], gop: int = 1
) -> Path:
    """An SVO2 file as its description has it: both eyes beside each other, a footer behind each
    access unit."""
    from mcap.writer import CompressionType, Writer

    images = [np.hstack(pair) for pair in pairs]
    height, width = pairs[0][0].shape[:2]
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start(profile="", library="test")
        channel = writer.register_channel("Camera_SN12345678/side_by_side", "", schema_id=0)
        for number, (unit, stamp) in enumerate(
            zip(access_units(images, gop=gop), stamps, strict=True)
        ):
            key = number % gop == 0
            numbers = (len(unit), 3 * key, number, number, number, 0)
            footer = struct.pack(
                "<iiIiiiQIIIIII", width, height, SVO_MAGIC, 1, 2, -1, stamp, *numbers
            )
            assert len(footer) == 56
            writer.add_message(channel, stamp, unit + footer, stamp)
        writer.finish()
    return path


def write_video(
    path: Path,
    images: Sequence[np.ndarray],
    rate: int = 10,
    gap_ms: int = 100,
    **stream_options: str,
) -> Path:
    """A video of BGR images some milliseconds apart in a stream that claims `rate` a second: FFV1,
    or H.264 in MP4."""
    import av

    lossless = path.suffix == ".mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1" if lossless else "libx264", rate=rate)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "bgr0" if lossless else "yuv420p"
        stream.options = stream_options
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="bgr24")
            frame.pts, frame.time_base = number * gap_ms, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path
