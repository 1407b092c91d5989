#!/usr/bin/env bash
# asyncua 2.1.0 (Python 3.11): its server ignores the IndexRange of a Read request.
#
# OPC 10000-4, 7.27 and 5.10.2: a client that asks for "3:5" of an array gets these three elements, or a Bad status.
# Seen: status Good and the whole array, for every range, also for one that is no range. A controller that asks for
# element 3 takes the first of what it gets, element 0, for it.
# A write with an IndexRange replaces the whole array in the same way, and a list is taken for a scalar: both Good.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q asyncua==2.1.0
"$work/venv/bin/python" - <<'PY'
import asyncio
import logging
import socket

from asyncua import Client, Server, ua

logging.disable(logging.CRITICAL)
with socket.create_server(("127.0.0.1", 0)) as probe:
    PORT = probe.getsockname()[1]


async def main() -> None:
    server = Server()
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{PORT}/")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    space = await server.register_namespace("urn:test")
    array = await server.nodes.objects.add_variable(space, "array", [0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
    scalar = await server.nodes.objects.add_variable(space, "scalar", 1, ua.VariantType.UInt32)
    for node in (array, scalar):
        await node.set_writable()
    async with server, Client(f"opc.tcp://127.0.0.1:{PORT}/") as client:
        for index_range in ("3:5", "3", "99", "nonsense"):
            item = ua.ReadValueId(array.nodeid, ua.AttributeIds.Value, index_range)
            (value,) = await client.uaclient.read(ua.ReadParameters(NodesToRead=[item]))
            print(f"read {index_range!r}: {value.StatusCode.name}, {value.Value.Value}")
            assert value.StatusCode.is_good() and len(value.Value.Value) == 6
        part = ua.WriteValue(array.nodeid, ua.AttributeIds.Value, "3", ua.DataValue(ua.Variant([9.0])))
        (status,) = await client.uaclient.write(ua.WriteParameters(NodesToWrite=[part]))
        print(f"write [9.0] to element 3: {status.name}, the array is {await array.read_value()}")
        assert status.is_good() and await array.read_value() == [9.0]
        many = ua.DataValue(ua.Variant([1, 2], ua.VariantType.UInt32))
        whole = ua.WriteValue(scalar.nodeid, ua.AttributeIds.Value, None, many)
        (status,) = await client.uaclient.write(ua.WriteParameters(NodesToWrite=[whole]))
        print(f"write [1, 2] to a scalar: {status.name}, the scalar is {await scalar.read_value()}")
        assert status.is_good() and await scalar.read_value() == [1, 2]


asyncio.run(main())
PY
