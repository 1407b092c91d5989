"""What OPC UA clients may do: who may connect, which writes are refused, and parts of arrays by
IndexRange.

asyncua 2.1 knows no IndexRange (every range is answered with the whole array and status Good) and
no ranks (a list is taken for a scalar). Both are settled here, before a client's request reaches
the address space.
"""

from __future__ import annotations

import hmac
import logging
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from asyncua import Server, ua

_log = logging.getLogger(__name__)

ONE_RANGE = re.compile(r"(\d{1,9})(?::(\d{1,9}))?", re.ASCII)


def guard(server: Server, writable: Collection[ua.NodeId]) -> None:
    """Put our rules before the server's own services; the `writable` nodes are scalars."""
    inner = server.iserver
    inner.attribute_service = _Attributes(inner.attribute_service, writable)
    subscriptions = inner.subscription_service
    subscriptions.create_monitored_items = _whole_items_only(subscriptions.create_monitored_items)


class _Attributes:
    """Reads parts of arrays, and refuses a list, or a part of one, where a single value belongs."""

    def __init__(self, service: Any, writable: Collection[ua.NodeId]) -> None:
        self._service, self._writable = service, writable

    def read(self, params: ua.ReadParameters) -> list[ua.DataValue]:
        """Values of attributes, or the parts of them that are asked for."""
        values = self._service.read(params)
        return [
            part(value, item.IndexRange)
            for value, item in zip(values, params.NodesToRead, strict=True)
        ]

    async def write(self, params: ua.WriteParameters, **user: Any) -> list[ua.StatusCode]:
        """Write what fits its node; a status code for each."""
        from asyncua import ua

        results = []
        for item in params.NodesToWrite:
            if refusal := self._refusal(item):
                results.append(ua.StatusCode(refusal))
            else:
                results += await self._service.write(
                    ua.WriteParameters(NodesToWrite=[item]), **user
                )
        return results

    def _refusal(self, item: ua.WriteValue) -> int:
        """Status code of a write that does not fit its node; 0: leave it to the server."""
        from asyncua import ua

        if item.NodeId not in self._writable or item.AttributeId != ua.AttributeIds.Value:
            return 0
        if item.IndexRange:
            return int(ua.StatusCodes.BadWriteNotSupported)
        return int(ua.StatusCodes.BadTypeMismatch) if item.Value.Value.is_array else 0


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
