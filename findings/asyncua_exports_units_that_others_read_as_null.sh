#!/usr/bin/env bash
# asyncua 2.1.0 and node-opcua 2.182.2: EngineeringUnits in an exported NodeSet2 file arrive as null.
#
# `export_xml(nodes, file, export_values=True)` writes an EUInformation under its data type, i=887. In the XML encoding of
# an ExtensionObject (OPC 10000-6) the TypeId is that of the encoding, here EUInformation's "Default XML": i=888. node-opcua loads the file without a complaint, status Good, and
# the unit is null. With 888 written over 887 in that place the unit is there.
# Needs node and npm.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q asyncua==2.1.0
(cd "$work" && npm install --silent --no-fund --no-audit node-opcua-address-space@2.182.2 node-opcua-nodesets@2.182.0 > npm.log)
"$work/venv/bin/python" - "$work" <<'PY'
import asyncio
import logging
import sys

from asyncua import Server, ua

logging.disable(logging.CRITICAL)
file = f"{sys.argv[1]}/exported.xml"


async def main() -> None:
    server = Server()
    await server.init()
    space = await server.register_namespace("urn:test")
    length = await server.nodes.objects.add_variable(ua.NodeId("length", space), f"{space}:length", 1.0)
    unit = ua.EUInformation("http://www.opcfoundation.org/UA/units/un/cefact", 5067858, ua.LocalizedText("m"))
    eu = await length.add_property(ua.NodeId("length.unit", space), "0:EngineeringUnits", unit)
    await server.export_xml([length, eu], file, export_values=True)


asyncio.run(main())
text = open(file, encoding="utf-8").read()
assert "<uax:Identifier>i=887</uax:Identifier>" in text
corrected = text.replace("<uax:Identifier>i=887</uax:Identifier>", "<uax:Identifier>i=888</uax:Identifier>")
open(f"{sys.argv[1]}/corrected.xml", "w", encoding="utf-8").write(corrected)
PY
cat > "$work/load.js" <<'JS'
const {AddressSpace} = require("node-opcua-address-space");
const {generateAddressSpace} = require("node-opcua-address-space/nodeJS");
const {nodesets} = require("node-opcua-nodesets");
(async () => {
  const space = AddressSpace.create();
  await generateAddressSpace(space, [nodesets.standard, process.argv[2]]);
  const value = space.findNode(`ns=${space.getNamespaceIndex("urn:test")};s=length.unit`).readValue();
  console.log(value.statusCode.name, value.value.value && value.value.value.displayName.text);
  space.dispose();
})();
JS
exported=$(cd "$work" && node load.js exported.xml 2> node.log)
corrected=$(cd "$work" && node load.js corrected.xml 2> node.log)
printf 'i=887: %s\ni=888: %s\n' "$exported" "$corrected"
test "$exported" = "Good null"
test "$corrected" = "Good m"
