"""The library's face: load a detector, open a recording, see what a pair shows."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from stereo_ore.chain import Chain
from stereo_ore.config import Config
from stereo_ore.errors import CloudError, FrameError
from stereo_ore.io import calibration as calibrations
from stereo_ore.io.parameters import load_config
from stereo_ore.io.posture import recorded_postures
from stereo_ore.io.recordings import BagOptions, Source, limit_pixels, open_source
from stereo_ore.io.results import Results
from stereo_ore.io.site import load_site
from stereo_ore.result import Result
from stereo_ore.runs.identity import InputFiles
from stereo_ore.runs.run import RunOptions
from stereo_ore.runs.run import run_recording as run_frames
from stereo_ore.stages import filters
from stereo_ore.types import F32, Mask, Rig, Site, StereoCalibration, StereoPair, centred_cloud

if TYPE_CHECKING:
    from typing import Self

_log = logging.getLogger(__name__)

AnyPath = str | PathLike[str]


def _path(path: AnyPath | None) -> Path | None:
    return Path(path) if path else None


class Detector:
    """Finds ore in stereo pairs of one camera.

    Parameters
    ----------
    calibration : StereoCalibration
        Of the camera, for raw or for rectified images.
    site : Site, optional
        Arm, working volume and grizzly, as far as they are known. Without it everything stays in
        the camera's frame.
    config : Config, optional
        Parameters of all stages.

    Raises
    ------
    CalibrationError, ConfigError
        When calibration, site and parameters contradict each other.
    """

    def __init__(
        self,
        calibration: StereoCalibration,
        site: Site | None = None,
        config: Config | None = None,
    ) -> None:
        self.chain = Chain(calibration, site, config, recorded_postures(site))
        self.inputs = InputFiles()

    @classmethod
    def load(
        cls,
        calibration: AnyPath,
        site: AnyPath | None = None,
        config: AnyPath | None = None,
        *,
        settings: Sequence[str] = (),
        image_size: tuple[int, int] | None = None,
    ) -> Self:
        """Load a detector from files, as `stereo-ore run` does.

        Parameters
        ----------
        calibration
            Calibration in any known format.
        site, config
            Site file, and parameters that differ from the defaults.
        settings
            Single parameters, such as ``"strike.max_slope_rad=0.5"``.
        image_size
            Width and height [px] of one eye, for calibration files of several resolutions.

        Raises
        ------
        StereoOreError
            Naming file, key, value and remedy.
        """
        files = InputFiles(Path(calibration), _path(site), _path(config))
        detector = cls(
            calibrations.load(Path(calibration), image_size=image_size),
            load_site(files.site) if files.site else None,
            load_config(files.config, settings),
        )
        detector.inputs = files
        return detector

    @property
    def rig(self) -> Rig:
        """Geometry of the rectified images."""
        return self.chain.rig

    def __call__(self, pair: StereoPair, *more: StereoPair) -> Result:
        """Return what a pair shows, or one and `more` of the same still scene measured together.

        A fault in the frame is no exception but a result whose `status` and `reasons` say it.
        """
        return Result(self.chain(pair, *more), self.chain.site)

    def __repr__(self) -> str:
        rig, site = self.rig, self.chain.site
        known = {"arm": site.T_arm_camera, "volume": site.volume, "plane": site.plane}
        parts = ", ".join(name for name, value in known.items() if value is not None)
        return (
            f"Detector({rig.width}×{rig.height} px, f {rig.fx:.1f} px, "
            f"baseline {1000 * rig.baseline_m:.1f} mm; site: {parts or 'not given'})"
        )


@dataclass(frozen=True)
class Recording:
    """A recording as a sequence of pairs; any length, read when asked for.

    Iteration leaves out the frames that can't be read, and logs each; ``recording[i]`` raises.
    """

    source: Source

    def __len__(self) -> int:
        return len(self.source.names)

    def __getitem__(self, index: int) -> StereoPair:
        """Read one frame.

        Raises
        ------
        FrameError
            When it is incomplete or unreadable.
        """
        return self.source.read(range(len(self))[index])

    def __iter__(self) -> Iterator[StereoPair]:
        for index in range(len(self)):
            try:
                yield self.source.read(index)
            except FrameError as error:
                _log.warning("frame %s is left out: %s", self.source.names[index], error)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the frames, in order."""
        return self.source.names

    @property
    def calibration(self) -> StereoCalibration | None:
        """Calibration that the recording itself carries."""
        return self.source.calibration

    def __repr__(self) -> str:
        return f"Recording({str(self.source.path)!r}, {len(self)} frames)"


def open_recording(
    path: AnyPath,
    *,
    topics: tuple[str, str] | None = None,
    max_skew_ms: float = 5.0,
    max_pixels: int = Config().source.max_pixels,
) -> Recording:
    """Open a recording: a folder in any known layout, a side-by-side video, or a bag.

    Parameters
    ----------
    path
        What `stereo-ore run` takes.
    topics, max_skew_ms
        Left and right image topic of a bag that has several, and the largest difference of stamps.
    max_pixels
        Larger pictures are refused before they are decoded.

    Raises
    ------
    SourceError
        When nothing is there, or its layout is none of the known ones.
    """
    source = open_source(Path(path), BagOptions(topics, max_skew_ms))
    return Recording(limit_pixels(source, max_pixels))


def run(
    recording: Recording | AnyPath,
    detector: Detector,
    out: AnyPath,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
    **options: Any,
) -> Results:
    """Process a recording into a folder of results, as `stereo-ore run` does.

    Parameters
    ----------
    recording
        A recording, or where one lies.
    detector
        What is done with each frame.
    out
        Folder for the results.
    progress
        Told after each frame how many of how many are done.
    options
        Fields of `RunOptions`: start, stop, every, workers, resume, overwrite, save_stages …

    Returns
    -------
    Results
        The folder, to be read back.

    Raises
    ------
    StereoOreError
        As the command line tells them.
    """
    opened = recording if isinstance(recording, Recording) else open_recording(recording)
    folder = Path(out)
    run_frames(
        opened.source, detector.chain, folder, RunOptions(**options), detector.inputs, progress
    )
    return Results(folder)


def filter_cloud(xyz: npt.ArrayLike, method: str = "adaptive", **params: Any) -> tuple[Mask, F32]:
    """Decide which points of a cloud are noise.

    Parameters
    ----------
    xyz : (N, 3) array
        Points [m].
    method : str
        "adaptive", "closed-form", "paper", "statistical", "radius", "lof" …
    params
        Parameters of the method, as `stereo-ore config dump` lists them.

    Returns
    -------
    keep : (N,) bool
        False for noise.
    score : (N,) float32
        Higher is noisier.

    Raises
    ------
    CloudError
        When `xyz` has another shape.
    ConfigError
        For an unknown method or parameter.
    """
    points = np.asarray(xyz, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise CloudError(f"has shape {points.shape}; (N, 3) is wanted", key="xyz")
    settings = [f"filter.method={method}"]
    config = load_config(None, settings).filter.model_copy(update={"params": params})
    result = filters.apply(centred_cloud(points), config)
    return result.keep, result.score
