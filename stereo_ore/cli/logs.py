"""Messages of the program as lines of JSON, for a log that other programs read."""

from __future__ import annotations

import json
import logging
from datetime import UTC, datetime
from enum import StrEnum

_PLAIN = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "asctime", "taskName"}
"""What every log record has; the rest are a message's own fields."""


class LogFormat(StrEnum):
    """How messages are written to standard error."""

    TEXT = "text"
    JSON = "json"


class JsonLines(logging.Formatter):
    """A line of JSON a message: time (UTC), level, logger, message, its own fields, and a traceback
    if any.
    """

    def format(self, record: logging.LogRecord) -> str:
        """One line, whatever the message holds."""
        time = (
            datetime.fromtimestamp(record.created, UTC)
            .isoformat(timespec="milliseconds")
            .replace("+00:00", "Z")
        )
        line = {
            "time": time,
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        line |= {key: value for key, value in record.__dict__.items() if key not in _PLAIN}
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=True, default=str)
