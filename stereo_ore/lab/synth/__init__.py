"""Made-up measurements with exact truth: ray-cast ore on a grizzly, and the published experiment's
cloud.
"""

from stereo_ore.lab.synth.families import FAMILIES, sample_spec
from stereo_ore.lab.synth.files import write
from stereo_ore.lab.synth.paper_cloud import NOISE_SHARES, Direction, paper_cloud
from stereo_ore.lab.synth.scene import Scene, scene
from stereo_ore.lab.synth.spec import SIZES, Camera, SceneSpec, Sensor
from stereo_ore.lab.synth.truth import LumpTruth

__all__ = [
    "FAMILIES",
    "NOISE_SHARES",
    "SIZES",
    "Camera",
    "Direction",
    "LumpTruth",
    "Scene",
    "SceneSpec",
    "Sensor",
    "paper_cloud",
    "sample_spec",
    "scene",
    "write",
]
