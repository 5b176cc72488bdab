import { parentPort, workerData } from "node:worker_threads";
import { XPublisher } from "zeromq";
import type { HeartbeatData } from "./heartbeat.js";

const ALIVE = 0;
const CLOSING = 1;
const IDLE_S = 0.5; // the event loop turns more often than that

const { address, curve, token, periodMs, longestStepS, turned } = workerData as HeartbeatData;
const socket = new XPublisher({ linger: 200, ...curve });
let sending: Promise<void> = Promise.resolve();

function beat(kind: number): void {
  const busyS = Number(process.hrtime.bigint() - Atomics.load(turned, 0)) / 1e9;
  const frames = [Buffer.of(kind), (busyS > IDLE_S ? busyS : 0).toFixed(3), longestStepS.toFixed(3), token];
  sending = sending.then(() => socket.send(frames));
}

/** Wait until the supervisor listens: a beat sent before would be lost. */
async function heard(): Promise<void> {
  for (;;) if ((await socket.receive())[0]?.[0] === 1) return;
}

socket.connect(address);
const timer = setInterval(() => beat(ALIVE), periodMs);
const isHeard = heard().then(() => beat(ALIVE));
parentPort?.once("message", async () => {
  clearInterval(timer);
  await isHeard;
  beat(CLOSING);
  await sending;
  socket.close();
  parentPort?.close();
});
