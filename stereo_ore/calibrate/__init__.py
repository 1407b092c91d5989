"""Making and judging calibrations."""
