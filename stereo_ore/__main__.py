"""``python -m stereo_ore``: the command line where the installed script is not on the path."""

from stereo_ore.cli import launch

launch()
