// node-opcua's view of the model, a line of JSON a variable.
// node node_opcua.js load MODEL.xml   the file in an address space of its own
// node node_opcua.js read URL         the running server, as a client reads it
"use strict";
const opcua = {...require("node-opcua-address-space"), ...require("node-opcua-client")};
const inner = name => require(require.resolve(name, {paths: [require.resolve("node-opcua-client")]}));
const say = row => process.stdout.write(JSON.stringify(row) + "\n");
const number = id => id.namespace === 0 ? id.value : id.toString();

async function load(file) {
  const {AddressSpace, generateAddressSpace} = {...opcua, ...require("node-opcua-address-space/nodeJS")};
  const space = AddressSpace.create();
  await generateAddressSpace(space, [require("node-opcua-nodesets").nodesets.standard, file]);
  const root = space.rootFolder.objects.getFolderElementByName("StereoOre") ||
    space.findNode(`ns=${space.getNamespaceIndex("urn:stereo-ore:targets")};s=StereoOre`);
  for (const folder of root.getComponents()) {
    for (const node of folder.getComponents()) {
      const unit = node.getPropertyByName("EngineeringUnits");
      const frame = node.getPropertyByName("Frame");
      const value = unit && unit.readValue().value.value;
      say({name: node.browseName.name, id: node.nodeId.value, rank: node.valueRank, type: number(node.dataType),
        dimensions: node.arrayDimensions, unit: value && [value.displayName.text, value.unitId],
        frame: frame && frame.readValue().value.value, access: node.accessLevel, text: node.description.text});
    }
  }
  const type = root.typeDefinitionObj, parts = type.getComponents().flatMap(folder =>
    folder.getComponents().filter(node => node.modellingRule === "Mandatory")
      .map(node => `${folder.browseName.name}.${node.browseName.name}`));
  say({name: "the type", id: type.browseName.name, of: type.subtypeOfObj.browseName.name, mandatory: parts});
  space.dispose();
}

async function read(url) {
  const client = opcua.OPCUAClient.create({endpointMustExist: false});
  await client.withSessionAsync(url, async session => {
    const namespace = (await session.readNamespaceArray()).indexOf("urn:stereo-ore:targets");
    for (const [folder, name, indexRange] of JSON.parse(process.argv[4])) {
      const nodeId = `ns=${namespace};s=StereoOre.${folder}.${name}`;
      const {NumericRange} = inner("node-opcua-numeric-range");
      const range = indexRange && new NumericRange(indexRange);
      const {statusCode, value} = await session.read({nodeId, attributeId: opcua.AttributeIds.Value, indexRange: range});
      const found = value && value.value;
      say({name, status: statusCode.name, value: ArrayBuffer.isView(found) ? Array.from(found) : found});
    }
  });
}

const act = {load, read}[process.argv[2]];
act(process.argv[3]).catch(fault => { process.stderr.write(String(fault.stack) + "\n"); process.exit(1); });
