"""The arm's posture, written by its controller into variables of the OPC UA server.

The arrays and `BodyCount` may be written one by one, or those alone that have changed;
`PostureStamp` hands over what all of them hold at that moment. In one request it counts as the
last, wherever it stands. A posture is handed over only while all its values are Good: values that
were never written since the server's start, and those whose last write was refused or had another
quality, are not, so that an old place of the arm never gets a new stamp.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

from stereo_ore.errors import ConfigError
from stereo_ore.plant.sinks.opcua_model import EPOCH, POSTURE, POSTURE_SLOTS

if TYPE_CHECKING:
    from asyncua import Node, Server, ua

_log = logging.getLogger(__name__)

TakePosture = Callable[[Any, str], None]
"""Takes in what a line of a posture holds, and from where; ConfigError for what is none."""


class PostureDesk:
    """Hands a posture on with each `PostureStamp`, and says why not.

    Parameters
    ----------
    server : Server
        Whose nodes they are.
    nodes : mapping
        Its nodes by the names of the model.
    take : TakePosture
        Where postures go.
    """

    def __init__(self, server: Server, nodes: Mapping[str, Node], take: TakePosture) -> None:
        self._space = server.iserver.aspace
        self._nodes = {variable.name: nodes[variable.name].nodeid for variable in POSTURE}
        self._take = take
        self.told = "no posture"

    def last(self, node: ua.NodeId) -> bool:
        """Whether it is the stamp, which hands over what the others hold."""
        return bool(node == self._nodes["PostureStamp"])

    async def written(self, node: ua.NodeId, answer: ua.StatusCode) -> ua.StatusCode:
        """Mark what was refused, and hand over what is stamped."""
        from asyncua import ua

        if node not in self._nodes.values():
            return answer
        if not answer.is_good():
            await self._doubt(node)
        elif self.last(node) and self._good("PostureStamp"):
            refusal, self.told = self._hand_over()
            answer = ua.StatusCode(refusal)
        return answer

    def _value(self, name: str) -> ua.DataValue:
        from asyncua import ua

        return self._space.read_attribute_value(self._nodes[name], ua.AttributeIds.Value)

    def _good(self, name: str) -> bool:
        status = self._value(name).StatusCode
        return status is None or bool(status.is_good())

    async def _doubt(self, node: ua.NodeId) -> None:
        """Leave its value, which clients may show, and say that it is not what the arm wanted."""
        from asyncua import ua

        held = self._space.read_attribute_value(node, ua.AttributeIds.Value)
        status = ua.StatusCode(ua.StatusCodes.UncertainLastUsableValue)
        await self._space.write_attribute_value(
            node, ua.AttributeIds.Value, replace(held, StatusCode=status)
        )

    def _hand_over(self) -> tuple[int, str]:
        """Status code of the stamp, and what is told of it."""
        from asyncua import ua

        missing = [variable.name for variable in POSTURE if not self._good(variable.name)]
        try:
            if missing:
                raise ConfigError(f"{', '.join(missing)} not written well", file=_WHERE)
            values = {name: self._value(name).Value.Value for name in self._nodes}
            self._take(_document(values), _WHERE)
        except ConfigError as fault:
            told = f"posture refused: {fault.problem}"
            if told != self.told:
                _log.warning("%s", fault)
            kind = ua.StatusCodes.BadInvalidState if missing else ua.StatusCodes.BadOutOfRange
            return int(kind), told
        return 0, f"posture of {values['BodyCount']} bodies"


_WHERE = "posture over OPC UA"


def _document(values: Mapping[str, Any]) -> dict[str, Any]:
    """What a line of JSON with this posture would hold."""
    count, places = values["BodyCount"], (values["From"], values["To"])
    if count > POSTURE_SLOTS:
        raise ConfigError(
            f"{count} is more than the {POSTURE_SLOTS} slots", file=_WHERE, key="BodyCount"
        )
    bodies = [
        {
            "name": values["Name"][slot],
            "from_m": places[0][3 * slot : 3 * slot + 3],
            "to_m": places[1][3 * slot : 3 * slot + 3],
            "radius_m": values["Radius"][slot],
        }
        for slot in range(count)
    ]
    return {
        "schema": "stereo_ore/posture/1",
        "stamp_ns": _nanoseconds(values["PostureStamp"]),
        "bodies": bodies,
    }


def _nanoseconds(time: datetime) -> int:
    """Since 1970, exact; a time without a zone is UTC, as in all of OPC UA."""
    aware = time if time.tzinfo else time.replace(tzinfo=UTC)
    return (aware - EPOCH) // timedelta(microseconds=1) * 1000
