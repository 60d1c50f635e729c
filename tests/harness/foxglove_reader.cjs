// Reads what Pancakes writes for Foxglove with Foxglove's own libraries, and prints one JSON line for each topic:
//   node foxglove_reader.cjs live ws://127.0.0.1:8765 TOPIC...     (until something has come on each topic)
//   node foxglove_reader.cjs file recording.mcap
const fs = require("node:fs");
const Ajv = require("ajv");
const published = require("@foxglove/schemas/jsonschema");

const ajv = new Ajv({ strict: false });
const checks = new Map();
const topics = new Map();

function take(topic, schemaName, data, time) {
  const found = topics.get(topic) || { topic, schemaName, count: 0, faults: [], last: null, time: null };
  topics.set(topic, found);
  found.count += 1;
  found.last = JSON.parse(new TextDecoder().decode(data));
  found.time = String(time);
  const name = schemaName.startsWith("foxglove.") ? schemaName.slice("foxglove.".length) : null;
  if (name === null) return;
  if (!checks.has(name)) checks.set(name, published[name] ? ajv.compile(published[name]) : null);
  const check = checks.get(name);
  if (check === null) found.faults.push(`${schemaName} is none of Foxglove's`);
  else if (!check(found.last)) found.faults.push(ajv.errorsText(check.errors));
}

function tell() {
  for (const found of topics.values()) console.log(JSON.stringify(found));
}

function live(address, wanted) {
  const { FoxgloveClient } = require("@foxglove/ws-protocol");
  const { WebSocket } = require("ws");
  const client = new FoxgloveClient({ ws: new WebSocket(address, ["foxglove.sdk.v1"]) });
  const subscribed = new Map();
  client.on("error", (error) => {
    console.error(String(error));
    process.exit(1);
  });
  client.on("advertise", (channels) => {
    for (const channel of channels) subscribed.set(client.subscribe(channel.id), channel);
  });
  client.on("message", (message) => {
    const channel = subscribed.get(message.subscriptionId);
    take(channel.topic, channel.schemaName, message.data, message.timestamp);
    if (wanted.every((topic) => topics.has(topic))) {
      tell();
      process.exit(0);
    }
  });
}

async function file(path) {
  const { McapIndexedReader } = require("@mcap/core");
  const { decompress } = require("fzstd");
  const bytes = fs.readFileSync(path);
  const readable = {
    size: async () => BigInt(bytes.length),
    read: async (offset, length) => new Uint8Array(bytes.subarray(Number(offset), Number(offset + length))),
  };
  const reader = await McapIndexedReader.Initialize({
    readable,
    decompressHandlers: { zstd: (data, size) => decompress(data, new Uint8Array(Number(size))) },
  });
  for await (const message of reader.readMessages()) {
    const channel = reader.channelsById.get(message.channelId);
    const schema = reader.schemasById.get(channel.schemaId);
    take(channel.topic, schema.name, message.data, message.logTime);
  }
  tell();
}

const [how, where, ...wanted] = process.argv.slice(2);
if (how === "live") live(where, wanted);
else file(where);
