// Foxglove's reader on a bag: node mcap_core.js FILE prints topic, schema, count and offered QoS, a line of JSON each.
"use strict";
const fs = require("fs");
const {McapIndexedReader} = require("@mcap/core");

async function main(file) {
  const handle = fs.openSync(file, "r");
  const size = BigInt(fs.fstatSync(handle).size);
  const readable = {
    size: async () => size,
    read: async (offset, length) => {
      const buffer = new Uint8Array(Number(length));
      fs.readSync(handle, buffer, 0, Number(length), Number(offset));
      return buffer;
    },
  };
  const reader = await McapIndexedReader.Initialize({readable});
  const counts = new Map();
  for await (const message of reader.readMessages()) counts.set(message.channelId, (counts.get(message.channelId) || 0) + 1);
  for (const [id, channel] of reader.channelsById) {
    const row = {topic: channel.topic, schema: reader.schemasById.get(channel.schemaId).name, count: counts.get(id)};
    process.stdout.write(JSON.stringify({...row, qos: channel.metadata.get("offered_qos_profiles")}) + "\n");
  }
}

main(process.argv[2]).catch(fault => { process.stderr.write(String(fault.stack) + "\n"); process.exit(1); });
