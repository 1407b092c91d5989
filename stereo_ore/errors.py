"""The one family of exceptions for known faults; only the command line catches it."""

from __future__ import annotations

from pathlib import Path
from typing import Any


class StereoOreError(Exception):
    """A known fault, worded for the person who can mend it.

    Parameters
    ----------
    problem
        What is wrong, with the offending value.
    file
        The file it was found in, if any.
    key
        The dotted key or field it concerns, if any.
    remedy
        What to do about it.
    """

    def __init__(
        self,
        problem: str,
        *,
        file: str | Path | None = None,
        key: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.problem, self.file, self.key, self.remedy = problem, file, key, remedy
        where = ": ".join(_shown(str(part), "") for part in (file, key) if part)
        problem = _shown(problem, "\n")
        text = f"{where}: {problem}" if where else problem
        stop = "" if problem.endswith("?") else "."
        super().__init__(f"{text}{stop} {remedy}" if remedy else text)

    def __reduce__(self) -> tuple[Any, ...]:
        """Errors come from worker processes: by default pickle would call `__init__` without the
        keywords.
        """
        return _rebuilt, (type(self), *self.args), self.__dict__


def _rebuilt(kind: type[StereoOreError], *args: str) -> StereoOreError:
    return kind.__new__(kind, *args)


def _shown(text: str, allowed: str) -> str:
    """Text for a line on a terminal: control characters and bytes that are no UTF-8 are written as
    escapes.
    """
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() or c in allowed else c.encode("unicode_escape").decode() for c in text
    )


class ConfigError(StereoOreError):
    """A parameter or site file, or a ``--set`` value, that can't be used."""


class CalibrationError(StereoOreError):
    """A calibration that is malformed, impossible, or made for other images."""


class SourceError(StereoOreError):
    """A recording that can't be opened or is laid out in no known way."""


class FrameError(StereoOreError):
    """One frame that can't be read or processed; the run goes on without it.

    `code` is the stable reason code of the frame's record.
    """

    def __init__(
        self,
        problem: str,
        *,
        code: str,
        file: str | Path | None = None,
        key: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.code = code
        super().__init__(problem, file=file, key=key, remedy=remedy)


class CloudError(StereoOreError):
    """A point cloud that can't be read, or on which an operation has no meaning."""


class OutputError(StereoOreError):
    """A result that can't be written."""


class ClusterError(StereoOreError):
    """A cluster that can't be reached, or whose workers can't do the work."""


class MissingExtraError(StereoOreError):
    """An optional part of the program that is not installed."""

    def __init__(self, package: str, extra: str, remedy: str | None = None) -> None:
        super().__init__(
            f"the optional package {package} is not installed",
            remedy=remedy or f'pip install "stereo-ore[{extra}]"',
        )
