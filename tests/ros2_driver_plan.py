"""What the driver of the tests and the tests themselves both know; without ROS 2."""

START = 1_790_000_000_000_000_000
"""Stamp of the first frame [ns]."""
STEP = 66_666_667
"""Between two stamps [ns]."""
