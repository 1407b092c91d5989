"""What OPC UA clients may do: who may connect, which writes are refused, and parts of arrays by
IndexRange.

asyncua 2.1 knows no IndexRange (every range is answered with the whole array and status Good), no
ranks (a list is taken for a scalar) and no lengths of arrays. All are settled here, before a
client's request reaches the address space.
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

from stereo_ore.plant.sinks.opcua_model import Variable

if TYPE_CHECKING:
    from asyncua import Server, ua

_log = logging.getLogger(__name__)

ONE_RANGE = re.compile(r"(\d{1,9})(?::(\d{1,9}))?", re.ASCII)


class Desk(Protocol):
    """What is made of the values of several variables together."""

    def last(self, node: ua.NodeId) -> bool:
        """Whether a request's values of other nodes are to be there before this one's."""

    async def written(self, node: ua.NodeId, answer: ua.StatusCode) -> ua.StatusCode:
        """The answer to a write that the server has answered so."""


def guard(server: Server, writable: Mapping[ua.NodeId, Variable], desk: Desk | None = None) -> None:
    """Put our rules before the server's own services."""
    inner = server.iserver
    inner.attribute_service = _Attributes(inner.attribute_service, writable, desk)
    subscriptions = inner.subscription_service
    subscriptions.create_monitored_items = _whole_items_only(subscriptions.create_monitored_items)


class _Attributes:
    """Reads parts of arrays, and refuses what is not of the type, rank and length of its node, or a
    part of it.
    """

    def __init__(
        self, service: Any, writable: Mapping[ua.NodeId, Variable], desk: Desk | None
    ) -> None:
        self._service, self._writable, self._desk = service, writable, desk
        self._turn = asyncio.Lock()

    def read(self, params: ua.ReadParameters) -> list[ua.DataValue]:
        """Values of attributes, or the parts of them that are asked for."""
        values = self._service.read(params)
        return [
            part(value, item.IndexRange)
            for value, item in zip(values, params.NodesToRead, strict=True)
        ]

    async def write(self, params: ua.WriteParameters, **user: Any) -> list[ua.StatusCode]:
        """Write what fits its node; a status code for each. One request is done at a time."""
        answers: dict[int, ua.StatusCode] = {}
        items = params.NodesToWrite
        async with self._turn:
            for place in sorted(range(len(items)), key=lambda place: self._last(items[place])):
                answers[place] = await self._write(items[place], user)
        return [answers[place] for place in range(len(items))]

    def _last(self, item: ua.WriteValue) -> bool:
        return self._desk is not None and self._desk.last(item.NodeId)

    async def _write(self, item: ua.WriteValue, user: Mapping[str, Any]) -> ua.StatusCode:
        from asyncua import ua

        answer = ua.StatusCode(self._refusal(item))
        if answer.is_good():
            request = ua.WriteParameters(NodesToWrite=[item])
            (answer,) = await self._service.write(request, **user)
        if self._desk is None or item.AttributeId != ua.AttributeIds.Value:
            return answer
        return await self._desk.written(item.NodeId, answer)

    def _refusal(self, item: ua.WriteValue) -> int:
        """Status code of a write that does not fit its node; 0: leave it to the server."""
        from asyncua import ua

        variable = self._writable.get(item.NodeId)
        if variable is None or item.AttributeId != ua.AttributeIds.Value:
            return 0
        if item.IndexRange:
            return int(ua.StatusCodes.BadWriteNotSupported)
        return 0 if _fits(item.Value, variable) else int(ua.StatusCodes.BadTypeMismatch)


def _fits(value: ua.DataValue, variable: Variable) -> bool:
    """Whether a value has the rank and the length of its variable, or is none, of bad quality; the
    type of its elements is the server's to check.
    """
    variant = value.Value
    if value.StatusCode is not None and value.StatusCode.is_bad() and variant.Value is None:
        return True
    if variable.length is None:
        return not variant.is_array
    flat = variant.is_array and len(variant.Dimensions or (0,)) == 1
    return flat and len(variant.Value or ()) == variable.length


def part(value: ua.DataValue, index_range: str | None) -> ua.DataValue:
    """The elements of an array, or characters of a string, that a NumericRange names (OPC 10000-4,
    7.27).

    A range that ends beyond the value gives what there is of it; one that begins there, or has
    another number of dimensions, is BadIndexRangeNoData.
    """
    from asyncua import ua

    if not index_range or (not value.StatusCode.is_good() and value.Value.Value is None):
        return value
    found = ONE_RANGE.fullmatch(index_range)
    first, last = (int(found[1]), int(found[2] or found[1])) if found else (0, 0)
    if "," in index_range:
        return ua.DataValue(StatusCode=ua.StatusCode(ua.StatusCodes.BadIndexRangeNoData))
    if not found or (found[2] and last <= first):
        return ua.DataValue(StatusCode=ua.StatusCode(ua.StatusCodes.BadIndexRangeInvalid))
    whole = value.Value.Value
    if not isinstance(whole, list | str | bytes) or first >= len(whole):
        return ua.DataValue(StatusCode=ua.StatusCode(ua.StatusCodes.BadIndexRangeNoData))
    return replace(
        value, Value=replace(value.Value, Value=whole[first : last + 1], Dimensions=None)
    )


def _whole_items_only(create: Callable[..., Any]) -> Callable[..., Any]:
    """Refuse to monitor a part of an array; a client may monitor the whole and take its part."""

    async def create_whole(
        params: ua.CreateMonitoredItemsParameters,
    ) -> list[ua.MonitoredItemCreateResult]:
        from asyncua import ua

        whole = [item for item in params.ItemsToCreate if not item.ItemToMonitor.IndexRange]
        made = iter(await create(replace(params, ItemsToCreate=whole)) if whole else ())
        refusal = ua.MonitoredItemCreateResult(
            StatusCode=ua.StatusCode(ua.StatusCodes.BadNotSupported)
        )
        return [
            refusal if item.ItemToMonitor.IndexRange else next(made)
            for item in params.ItemsToCreate
        ]

    return create_whole


class Users:
    """Who may connect: anybody without a list of users, else those on it with their password.
    Nobody is an admin.
    """

    def __init__(self, passwords: Mapping[str, str] | None) -> None:
        self._passwords = passwords

    def get_user(
        self,
        iserver: Any,
        username: str | None = None,
        password: str | None = None,
        certificate: Any = None,
    ) -> Any:
        """Give an ordinary user, or None for a login that is refused."""
        from asyncua.server.user_managers import User, UserRole

        if self._passwords is None:
            return User(role=UserRole.User)
        expected = self._passwords.get(username or "")
        if expected is None or not hmac.compare_digest(
            expected.encode(), (password or "").encode()
        ):
            _log.warning("OPC UA: login refused")
            return None
        return User(role=UserRole.User, name=username)
