#!/usr/bin/env bash
# pymodbus 3.16.1 (Python 3.11): of two requests that arrive in one TCP segment its server answers the first only.
#
# "MODBUS Messaging on TCP/IP Implementation Guide" V1.0b: several transactions may be outstanding on a connection, told
# apart by their transaction identifiers. Seen: the second request waits in the buffer until the
# next data arrives, so a master that pipelines runs into its time-out at every second request.
# A function code that pymodbus does not know (65) is answered with function 0x80 instead of 65 + 0x80 = 0xC1, which a
# master can't match to its request.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q pymodbus==3.16.1
"$work/venv/bin/python" - <<'PY'
import asyncio
import logging
import socket
import struct

from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

logging.disable(logging.CRITICAL)
with socket.create_server(("127.0.0.1", 0)) as probe:
    PORT = probe.getsockname()[1]


def request(transaction: int, address: int) -> bytes:
    """Read one holding register of device 1."""
    return struct.pack(">HHHBBHH", transaction, 0, 6, 1, 3, address, 1)


async def received(reader: asyncio.StreamReader) -> bytes:
    try:
        return await asyncio.wait_for(reader.read(1000), 1.0)
    except TimeoutError:
        return b""


async def main() -> None:
    device = SimDevice(0, simdata=[SimData(0, values=[10, 11, 12], datatype=DataType.REGISTERS)])
    server = ModbusTcpServer(device, address=("127.0.0.1", PORT))
    await server.serve_forever(background=True)
    reader, writer = await asyncio.open_connection("127.0.0.1", PORT)
    writer.write(request(1, 0) + request(2, 1))
    answer = await received(reader)
    print("two requests:", answer.hex(" "))
    assert answer == bytes.fromhex("0001 0000 0005 01 03 02 000a"), "expected here: the first answer alone"
    assert await received(reader) == b""
    writer.close()
    reader, writer = await asyncio.open_connection("127.0.0.1", PORT)
    writer.write(struct.pack(">HHHBB", 9, 0, 2, 1, 65))
    answer = await received(reader)
    print("unknown function 65:", answer.hex(" "))
    assert answer == bytes.fromhex("0009 0000 0003 01 80 01")
    writer.close()
    await server.shutdown()


asyncio.run(main())
PY
