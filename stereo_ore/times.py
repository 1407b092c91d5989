"""Times as text that no reader rounds."""

from __future__ import annotations

from datetime import UTC, datetime


def utc(nanoseconds: int | None) -> str | None:
    """RFC 3339 text, UTC, with nine digits of a second, of a time in ns since 1970; None for None
    and for years that it can't write.
    """
    if nanoseconds is None:
        return None
    seconds, rest = divmod(nanoseconds, 10**9)
    try:
        return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest:09d}Z"
    except (ValueError, OverflowError, OSError):
        return None
