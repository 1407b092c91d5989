"""Every parser of the program, and what it may do with a file: return something, or refuse it by a
typed error.

Whatever else leaves it (another exception, a warning) is a find. `corpus/NAME` holds small files
for each: valid ones to begin from, and what fuzzing has kept because it reached something new."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from stereo_ore.calibrate.tables import read_poses, read_touched
from stereo_ore.errors import StereoOreError
from stereo_ore.io import calibration, clouds
from stereo_ore.io.parameters import load_config
from stereo_ore.io.recordings import open_source
from stereo_ore.io.recordings.container import read_container
from stereo_ore.io.recordings.frame_packing import packing_of
from stereo_ore.io.recordings.images import read_image
from stereo_ore.io.recordings.stamps import stamp_table
from stereo_ore.io.results import Results, parse_record
from stereo_ore.io.site import load_site
from stereo_ore.plant.sinks.settings import load_sinks, read_users
from stereo_ore.runs.folder import whole_lines
from stereo_ore.stages.matching import background

CORPUS = Path(__file__).parent / "corpus"
IMAGE_SIZE = (1280, 720)


@dataclass(frozen=True)
class Parser:
    """A parser, and the name under which it gets its file."""

    file: str
    read: Callable[[Path], object]

    def __call__(self, data: bytes, folder: Path) -> StereoOreError | None:
        """Read `data` as a file in `folder`; the refusal, if any."""
        path = folder / self.file
        path.write_bytes(data)
        path.chmod(0o600)
        try:
            self.read(path)
        except StereoOreError as refusal:
            return refusal
        return None


def read_calibration(path: Path) -> object:
    return calibration.load(path, image_size=IMAGE_SIZE)


def read_ros(path: Path) -> object:
    """The other eye's file is a good one."""
    shutil.copyfile(CORPUS.parent / "right.yaml", path.with_name("right.yaml"))
    return calibration.load(path)


def read_beside(path: Path) -> object:
    """A calibration of several files; the others are good ones."""
    for file in (CORPUS.parent / "beside").iterdir():
        if file.name != path.name:
            shutil.copyfile(file, path.with_name(file.name))
    return calibration.load(path)


def read_source(path: Path) -> object:
    """All frames; a frame that can't be read is a refusal of that frame alone."""
    source = open_source(path)
    refused = None
    for index in range(len(source.names)):
        try:
            source.read(index)
        except StereoOreError as error:
            refused = error
    if refused:
        raise refused
    return source.description


def read_stamps(path: Path) -> object:
    """Of frames, from the table beside their images."""
    return stamp_table(path.parent)


def read_packing(path: Path) -> object:
    """Of an access unit."""
    return packing_of(path.read_bytes())


def read_records(path: Path) -> object:
    return Results(path.parent).records


def read_part(path: Path) -> object:
    """The last whole record of a run that grows."""
    lines = enumerate(whole_lines(path), 1)
    records = (parse_record(line.decode("utf-8", "replace"), path, n) for n, line in lines)
    return list(records)[-1:]


PARSERS = {
    "config": Parser("config.yaml", load_config),
    "site": Parser("site.yaml", load_site),
    "sinks": Parser("sinks.yaml", load_sinks),
    "users": Parser("users", read_users),
    "native": Parser("camera.yaml", read_calibration),
    "zed": Parser("SN1.conf", read_calibration),
    "opencv": Parser("camera.yml", read_calibration),
    "ros": Parser("left.yaml", read_ros),
    "kalibr": Parser("chain.yaml", read_calibration),
    "middlebury": Parser("calib.txt", read_calibration),
    "orbslam": Parser("settings.yaml", read_calibration),
    "simplestereo": Parser("rig.json", read_calibration),
    "depthai": Parser("calib.json", read_calibration),
    "calibrating": Parser("calibrating.yaml", read_calibration),
    "camera_array": Parser("camera_array.toml", read_calibration),
    "mrcal": Parser("left.cameramodel", read_beside),
    "colmap": Parser("rigs.txt", read_beside),
    "pycamcalib": Parser("camera_1_parameters.json", read_beside),
    "euroc": Parser("cam0_sensor.yaml", read_beside),
    "basalt": Parser("basalt.json", read_calibration),
    "kitti": Parser("calib_cam_to_cam.txt", read_calibration),
    "matlab": Parser("stereoParams.json", read_calibration),
    "vins": Parser("vins.yaml", read_beside),
    "stella": Parser("stella.yaml", read_calibration),
    "named": Parser("stereo.json", read_calibration),
    "touched": Parser("touched.csv", read_touched),
    "poses": Parser("poses.csv", read_poses),
    "ply": Parser("cloud.ply", clouds.read),
    "pcd": Parser("cloud.pcd", clouds.read),
    "npy": Parser("cloud.npy", clouds.read),
    "npz": Parser("cloud.npz", clouds.read),
    "text": Parser("cloud.csv", clouds.read),
    "las": Parser("cloud.las", clouds.read),
    "image": Parser("image.png", read_image),
    "stamps": Parser("data.csv", read_stamps),
    "db3": Parser("rec_0.db3", read_source),
    "rosbag1": Parser("recording.bag", read_source),
    "mcap": Parser("recording.mcap", read_source),
    "video": Parser("recording.avi", read_source),
    "matroska": Parser("recording.mkv", read_container),
    "mp4": Parser("recording.mp4", read_container),
    "packing": Parser("unit", read_packing),
    "stereo_jpeg": Parser("both.jpg", read_source),
    "svo2": Parser("ride.svo2", read_source),
    "foxglove": Parser("images.mcap", read_source),
    "background": Parser("empty.npz", background.load_background),
    "records": Parser("frames.jsonl", read_records),
    "part": Parser("frames.jsonl.part", read_part),
}
