"""Training of what is learned: the adaptive filter's scorers, and the segmentation's two logistic models."""
