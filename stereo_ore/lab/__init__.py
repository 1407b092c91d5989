"""The laboratory: made-up scenes, judges, benchmarks, training."""
