// Prints the messages of an MCAP file as JSON, {topic: [message]}, by the readers of JavaScript that viewers use.
// node read_mcap.mjs DIRECTORY_WITH_NODE_MODULES FILE
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";

const [directory, file] = process.argv.slice(2);
const require = createRequire(`${directory}/`);
const { McapStreamReader } = require("@mcap/core");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const zstd = require("@foxglove/wasm-zstd");
await zstd.isLoaded;

const reader = new McapStreamReader({
  validateCrcs: true,
  decompressHandlers: { zstd: (data, size) => zstd.decompress(data, Number(size)) },
});
reader.append(readFileSync(file));
const [schemas, channels, found] = [new Map(), new Map(), {}];
for (let record; (record = reader.nextRecord()); ) {
  if (record.type === "Schema") {
    const definition = parse(new TextDecoder().decode(record.data), { ros2: true });
    schemas.set(record.id, new MessageReader(definition));
  } else if (record.type === "Channel") {
    channels.set(record.id, record);
  } else if (record.type === "Message") {
    const { topic, schemaId } = channels.get(record.channelId);
    const message = schemas.get(schemaId).readMessage(record.data);
    (found[topic] ??= []).push({ ...message, log_time: record.logTime });
  }
}
const plain = (_, value) =>
  typeof value === "bigint" ? value.toString() : ArrayBuffer.isView(value) ? Array.from(value) : value;
console.log(JSON.stringify(found, plain));
