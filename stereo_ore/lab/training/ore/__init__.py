"""The network of lumps: its scenes, its crops, its training, and the model folder it becomes."""
