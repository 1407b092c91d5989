"""What a run says when it ends: the cause of bad frames first, sums of usable frames, and how it
went.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from stereo_ore.types import Json

_log = logging.getLogger(__name__)


CAUSES = ("OTHER_SCENE", "EYES_DISAGREE", "ROWS_DISAGREE")
"""Reasons that explain all the others of a frame, the first before the second."""
CONSEQUENCES = ("NO_SCREEN", "SCREEN_MOVED", "NO_POINTS", "FEW_DISPARITIES")
"""Reasons that other reasons explain."""
OF_THE_SITE = ("NO_ARM_FRAME", "NO_VOLUME_GIVEN", "NO_PLANE_GIVEN", "SITE_NOT_CONFIRMED")
"""Reasons that hold for each frame of a run, and explain none."""
USABLE = ("ok", "empty")
MOST_COMPLAINTS = 5
"""Frames that are told about on standard error; all are in the records."""


def cause(reasons: Sequence[Json]) -> Json:
    """The reason that a person should look into first: what explains the others, else the last."""

    def rank(reason: Json) -> int:
        code = reason["code"]
        if code in CAUSES:
            return CAUSES.index(code)
        return len(CAUSES) + (code in CONSEQUENCES) + 2 * (code in OF_THE_SITE)

    first = min(map(rank, reasons))
    return [reason for reason in reasons if rank(reason) == first][-1]


class Closing:
    """Sums over the records of a run; frames that can't be used count as frames alone."""

    def __init__(self, records: Iterable[Json]) -> None:
        self.totals: Counter[str] = Counter()
        self.bad: list[Json] = []
        self.last: Json = {}
        self._withheld: dict[str, str] = {}
        for record in records:
            self.last = record
            self.totals.update({"frames": 1, record["status"]: 1})
            if record["status"] in USABLE:
                self.totals.update({key: record["counts"][key] for key in ("ores", "targets")})
                if record["status"] == "ok":
                    self._withheld |= {r["code"]: r["detail"] for r in record["reasons"]}
            elif len(self.bad) < MOST_COMPLAINTS:
                self.bad.append(record)

    @property
    def withheld(self) -> str:
        """Why usable frames have no targets, in brackets; empty where nothing is said against
        them.
        """
        return f" ({'; '.join(self._withheld.values())})" if self._withheld else ""

    def complain(self) -> None:
        """Say of the first bad frames what is wrong with them."""
        for record in self.bad:
            _log.warning(
                "frame %s is %s: %s",
                record["frame"],
                record["status"],
                cause(record["reasons"])["detail"],
            )

    def check_usable(self) -> None:
        """End with the exit code of a failed quality gate where no frame is usable."""
        from stereo_ore.cli import EXIT_QUALITY

        if self.bad and not any(self.totals[status] for status in USABLE):
            typer.echo(
                f"error: no frame is usable; the first: {cause(self.bad[0]['reasons'])['detail']}",
                err=True,
            )
            raise typer.Exit(EXIT_QUALITY)
