"""Stereo vision for ore on a grizzly screen: recorded pairs in, crusher-arm targets out."""

__version__ = "0.1.0"
