"""What runs networks: ONNX Runtime on the processor."""

from __future__ import annotations

from typing import Any

_FATAL = 4
"""ONNX Runtime's level of messages that alone is shown: its errors are raised as well."""


def session(onnx: bytes, threads: int) -> Any:
    """A network of an ONNX file, ready to run; any number of threads may call it at once.

    It gives the same bytes for any number of threads of its own; other processors and versions of
    ONNX Runtime may differ by about 1e-5.
    """
    import onnxruntime

    onnxruntime.disable_telemetry_events()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.use_deterministic_compute = True
    options.log_severity_level = _FATAL
    # Memory of one frame is no use to the next, which has another size.
    options.enable_cpu_mem_arena = options.enable_mem_pattern = False
    # Threads that wait for work must not keep others from theirs.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return onnxruntime.InferenceSession(onnx, options, providers=["CPUExecutionProvider"])
