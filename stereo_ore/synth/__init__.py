"""Made-up measurements with exact truth: ray-cast ore on a grizzly, and the published experiment's cloud."""

from stereo_ore.synth.paper_cloud import NOISE_SHARES, paper_cloud

__all__ = ["NOISE_SHARES", "paper_cloud"]
