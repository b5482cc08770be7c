// SPDX-License-Identifier: Apache-2.0
// Reads an MCAP file with @mcap/core and prints, for each topic: messages, first and last log time, and the sums of all
// numbers in them, decoded by the definitions in the file. Started by mcap_core.py.

import { open } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import { decompress } from "fzstd";

const file = await open(process.argv[2], "r");
const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, length) => {
    const data = new Uint8Array(Number(length));
    const { bytesRead } = await file.read(data, 0, data.length, Number(offset));
    if (bytesRead !== data.length) throw new Error(`only ${bytesRead} of ${data.length} bytes at ${offset}`);
    return data;
  },
};
const reader = await McapIndexedReader.Initialize({
  readable,
  decompressHandlers: { zstd: (data, size) => decompress(data, new Uint8Array(Number(size))) },
});

const seconds = (stamp) => stamp.sec + 1e-9 * stamp.nanosec;
function numbers(value, name, sums) { // every finite number, by its dotted name; stamps in seconds
  if (typeof value === "number" || typeof value === "bigint") sums[name] = (sums[name] ?? 0) + Number(value);
  else if (ArrayBuffer.isView(value) || Array.isArray(value)) for (const part of value) numbers(part, name, sums);
  else if (value && typeof value === "object")
    for (const [key, part] of Object.entries(value)) {
      if (key === "stamp") sums[`${name}stamp`] = (sums[`${name}stamp`] ?? 0) + seconds(part);
      else numbers(part, name ? `${name}${key}.` : `${key}.`, sums);
    }
}

const found = {}, readers = new Map();
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const channel = reader.channelsById.get(message.channelId);
  let decode = readers.get(channel.id);
  if (!decode) {
    const schema = reader.schemasById.get(channel.schemaId);
    decode = new MessageReader(parse(new TextDecoder().decode(schema.data), { ros2: true }));
    readers.set(channel.id, decode);
    found[channel.topic] = { type: schema.name, count: 0, first: String(message.logTime), last: "", sums: {} };
  }
  const row = found[channel.topic];
  row.count += 1;
  row.last = String(message.logTime);
  numbers(decode.readMessage(message.data), "", row.sums);
}
console.log(JSON.stringify(found));
