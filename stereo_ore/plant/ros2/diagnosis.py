"""How a run is doing, as other programs of ROS collect it (REP 107)."""

from __future__ import annotations

from typing import Any

from stereo_ore.io.ros_frame import RosFrame
from stereo_ore.plant.sinks.message import Message
from stereo_ore.times import utc

OK, WARN, ERROR = b"\x00", b"\x01", b"\x02"
_LEVELS = {"ok": OK, "empty": OK, "failed": ERROR}
"""By status of the message; all others warn."""


def diagnostics(
    ros: RosFrame, message: Message, name: str, camera: str, latency_s: float | None
) -> Any:
    """DiagnosticArray of the latest message: status, reasons, targets, and how old its frame was
    when it was published.
    """
    values = {
        "status": message.status,
        "reasons": " ".join(message.reasons),
        "frame": message.frame or "",
        "targets": str(len(message.targets)),
        "valid": str(message.valid).lower(),
        "valid_until_utc": utc(message.valid_until_ns) or "",
        "latency_ms": "" if latency_s is None else f"{1000 * latency_s:.1f}",
        "sequence": str(message.sequence),
        "session": message.origin.session,
        "transform_id": message.origin.transform_id or "",
        "replay": str(message.origin.replay).lower(),
    }
    pairs = [
        ros.types["diagnostic_msgs/msg/KeyValue"](key=key, value=value)
        for key, value in values.items()
    ]
    reasons = f" ({values['reasons']})" if message.reasons else ""
    status = ros.types["diagnostic_msgs/msg/DiagnosticStatus"](
        level=_LEVELS.get(message.status, WARN),
        name=name,
        message=f"{message.status}{reasons}, {values['targets']} targets",
        hardware_id=camera,
        values=pairs,
    )
    return ros.types["diagnostic_msgs/msg/DiagnosticArray"](header=ros.header(""), status=[status])
