// A client of the Foxglove WebSocket protocol, made of the public libraries that viewers are made of. A line of input is
// a command in JSON, a line of output its answer; messages are decoded by the schemas that the server sends.
import { createInterface } from "node:readline";

import rosmsg from "@foxglove/rosmsg";
import serialization from "@foxglove/rosmsg2-serialization";
import protocol from "@foxglove/ws-protocol";
import { WebSocket } from "ws";

const { parse } = rosmsg;
const { MessageReader, MessageWriter } = serialization;
const { FoxgloveClient } = protocol;

const ws = new WebSocket(process.argv[2], [FoxgloveClient.SUPPORTED_SUBPROTOCOL]);
const client = new FoxgloveClient({ ws });
const channels = new Map();
const services = new Map();
const taken = new Map();
const statuses = [];
const waiting = new Map();
let calls = 0;
let serverInfo;

const say = (answer) => process.stdout.write(JSON.stringify(answer) + "\n");
const types = (schema) => parse(schema, { ros2: true });

client.on("error", (error) => say({ error: String(error.message ?? error) }));
client.on("close", () => {
  say({ closed: true });
  process.exit(0);
});
const connected = new Promise((resolve) =>
  client.on("serverInfo", (info) => {
    serverInfo = info;
    resolve();
  }),
);
client.on("status", (status) => statuses.push(status.message));
client.on("advertise", (found) => found.forEach((channel) => channels.set(channel.topic, channel)));
client.on("unadvertise", (ids) => {
  for (const [topic, channel] of channels) if (ids.includes(channel.id)) channels.delete(topic);
});
client.on("advertiseServices", (found) => found.forEach((service) => services.set(service.name, service)));
client.on("unadvertiseServices", (ids) => {
  for (const [name, service] of services) if (ids.includes(service.id)) services.delete(name);
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const topic = taken.get(subscriptionId);
  topic.count += 1;
  topic.newest = data;
  if (topic.stamps) {
    const { sec, nanosec } = topic.reader.readMessage(data).header.stamp;
    topic.stamps.push((BigInt(sec) * 1000000000n + BigInt(nanosec)).toString());
  }
});
client.on("parameterValues", ({ parameters, id }) => waiting.get(id)?.({ parameters }));
client.on("serviceCallFailure", ({ callId, message }) => waiting.get(callId)?.({ failure: message }));
client.on("serviceCallResponse", ({ callId, data, serviceId }) => {
  const service = [...services.values()].find((each) => each.id === serviceId);
  waiting.get(callId)?.({ response: new MessageReader(types(service.response.schema)).readMessage(data) });
});

const once = (key, send) =>
  new Promise((resolve) => {
    waiting.set(key, resolve);
    send();
  });

const commands = {
  seen: () => ({
    serverInfo,
    statuses,
    topics: Object.fromEntries([...channels.values()].map((channel) => [channel.topic, channel.schemaName])),
    services: Object.fromEntries([...services.values()].map((service) => [service.name, service.type])),
  }),
  subscribe: ({ topics, stamps }) => {
    for (const topic of topics) {
      const { id, schema } = channels.get(topic);
      const entry = { topic, count: 0, reader: new MessageReader(types(schema)), stamps: stamps ? [] : undefined };
      taken.set(client.subscribe(id), entry);
    }
    return {};
  },
  taken: () =>
    Object.fromEntries(
      [...taken.values()].map(({ topic, count, newest, reader, stamps }) => [
        topic,
        { count, stamps, newest: newest && reader.readMessage(newest) },
      ]),
    ),
  call: ({ service, request }) => {
    const { id, request: schema } = services.get(service);
    const content = new MessageWriter(types(schema.schema)).writeMessage(request);
    const data = new DataView(content.buffer, content.byteOffset, content.byteLength);
    const callId = ++calls;
    return once(callId, () => client.sendServiceCallRequest({ serviceId: id, callId, encoding: "cdr", data }));
  },
  get: ({ names }) => once("get", () => client.getParameters(names, "get")),
  set: ({ parameters }) => once("set", () => client.setParameters(parameters, "set")),
};

const plain = (_, value) =>
  typeof value === "bigint" ? value.toString() : ArrayBuffer.isView(value) ? Array.from(value) : value;

await connected;
for await (const line of createInterface({ input: process.stdin })) {
  const { command, ...rest } = JSON.parse(line);
  const answer = await commands[command](rest);
  process.stdout.write(JSON.stringify(answer, plain) + "\n");
}
client.close();
