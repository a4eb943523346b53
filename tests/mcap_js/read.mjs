// Reads MCAP files as Foxglove does: by index, and in order. A line of input is the path of a file; the line of output
// is JSON with the number of messages that each reader found, their log times' digest, or an error.
import { createHash } from "node:crypto";
import { open } from "node:fs/promises";
import { createInterface } from "node:readline";

import zstd from "@foxglove/wasm-zstd";
import { McapIndexedReader, McapStreamReader } from "@mcap/core";

await zstd.isLoaded;
const decompressHandlers = { zstd: (data, size) => new Uint8Array(zstd.decompress(data, Number(size))) };

class Tally {
  channels = {};
  count = 0;
  #hash = createHash("sha256");
  take(topic, message) {
    this.count += 1;
    this.channels[topic] = (this.channels[topic] ?? 0) + 1;
    this.#hash.update(message.data);
  }
  get result() {
    return { count: this.count, topics: this.channels, sha256: this.#hash.digest("hex") };
  }
}

async function byIndex(file) {
  const { size } = await file.stat();
  const readable = {
    size: async () => BigInt(size),
    read: async (offset, length) => {
      const buffer = new Uint8Array(Number(length));
      const { bytesRead } = await file.read(buffer, 0, Number(length), Number(offset));
      if (bytesRead !== Number(length)) throw new Error(`read ${bytesRead} of ${length} bytes at ${offset}`);
      return buffer;
    },
  };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const tally = new Tally();
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    tally.take(reader.channelsById.get(message.channelId).topic, message);
  }
  return {
    ...tally.result,
    metadata: reader.metadataIndexes.map((index) => index.name),
    attachments: reader.attachmentIndexes.map((index) => index.name),
  };
}

async function inOrder(file) {
  const reader = new McapStreamReader({ includeChunks: false, decompressHandlers, validateCrcs: true });
  const tally = new Tally();
  const channels = new Map();
  const buffer = new Uint8Array(1 << 20);
  let at = 0;
  while (true) {
    const { bytesRead } = await file.read(buffer, 0, buffer.length, at);
    if (bytesRead === 0) break;
    at += bytesRead;
    reader.append(buffer.subarray(0, bytesRead));
    for (let record; (record = reader.nextRecord()); ) {
      if (record.type === "Channel") channels.set(record.id, record.topic);
      if (record.type === "Message") tally.take(channels.get(record.channelId), record);
    }
  }
  return { ...tally.result, done: reader.done() };
}

for await (const path of createInterface({ input: process.stdin })) {
  const answer = {};
  for (const [name, read] of Object.entries({ byIndex, inOrder })) {
    const file = await open(path);
    try {
      answer[name] = await read(file);
    } catch (error) {
      answer[name] = { error: String(error.message ?? error) };
    } finally {
      await file.close();
    }
  }
  process.stdout.write(JSON.stringify(answer) + "\n");
}
