"""Quality and speed against baselines, as the README states them."""
