import assert from "node:assert/strict";
import { test } from "node:test";
import { curveKeyPair } from "zeromq";
import { encodePacket, type Packet } from "../src/frames.js";
import type { Keys } from "../src/launch.js";
import { Publisher } from "../src/publisher.js";
import { Subscription } from "../src/subscription.js";

const ADDRESS = "tcp://127.0.0.1:19873";
const [publisher, known, stranger] = [curveKeyPair(), curveKeyPair(), curveKeyPair()];

function keysOf(name: string, pair: typeof known): Keys {
  const peers = { [publisher.publicKey]: "publisher", [known.publicKey]: "known" };
  return { name, public: pair.publicKey, secret: pair.secretKey, peers, servers: { [ADDRESS]: "publisher" }, everywhere: true };
}

test("with keys, what is published reaches those whose key is known, and nobody else", async () => {
  const packets: Record<string, Packet[]> = { known: [], stranger: [] };
  const subscriptions = [known, stranger].map((pair, index) => {
    const name = index ? "stranger" : "known";
    const nothing = () => undefined;
    const handlers = { onPacket: (packet: Packet) => packets[name]!.push(packet), onCaughtUp: nothing, onKill: nothing, onDropped: nothing };
    return new Subscription(name, ADDRESS, ["Note"], keysOf(name, pair), handlers);
  });
  const published = new Publisher(ADDRESS, keysOf("publisher", publisher));
  const deadline = performance.now() + 10_000;
  while (packets["known"]!.length < 3 && performance.now() < deadline) {
    await published.publish((timeNs) => encodePacket({ envelope: "Note", payload: Buffer.of(), timeNs }), 5n);
    await new Promise((resolve) => setTimeout(resolve, 50));
  }
  for (const subscription of subscriptions) subscription.close();
  await published.close();
  assert.ok(packets["known"]!.length >= 3);
  assert.deepEqual(packets["stranger"], []);
  const times = packets["known"]!.map(({ timeNs }) => timeNs!);
  assert.ok(times.every((time, index) => index === 0 || time > times[index - 1]!), "times increase, though the clock stands still");
});
