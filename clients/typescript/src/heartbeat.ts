/** Heartbeats: a thread of its own says that this process is alive, and for how long its event loop has been busy. */

import { Worker } from "node:worker_threads";
import { curveOptions, type Launch } from "./launch.js";

const TURN_MS = 100;
const CLOSED_WITHIN_MS = 1000;

/** The data with which the thread starts. */
export interface HeartbeatData {
  readonly address: string;
  readonly curve: ReturnType<typeof curveOptions>;
  readonly token: string;
  readonly periodMs: number;
  readonly longestStepS: number;
  /** Nanoseconds of `process.hrtime` when the event loop last turned. */
  readonly turned: BigInt64Array;
}

/** Sends beats until it is closed. */
export class Heartbeat {
  private readonly worker: Worker;
  private readonly timer: NodeJS.Timeout;

  /** @param longestStepS for how many seconds the event loop may be busy before this process counts as frozen. */
  constructor(launch: Launch, address: string, longestStepS: number) {
    const turned = new BigInt64Array(new SharedArrayBuffer(8));
    const turn = () => Atomics.store(turned, 0, process.hrtime.bigint());
    turn();
    this.timer = setInterval(turn, TURN_MS).unref();
    // beats stay on this computer: they are encrypted where the launch line has a key for them
    const curve = launch.keys && address in launch.keys.servers ? curveOptions(launch.keys, address) : {};
    const workerData: HeartbeatData = { address, curve, token: launch.beat_token, periodMs: launch.beat_period_s * 1000, longestStepS, turned };
    this.worker = new Worker(new URL("./heartbeat_thread.js", import.meta.url), { workerData });
    this.worker.unref();
  }

  /** Send the closing beat: the process ends on purpose. */
  async close(): Promise<void> {
    clearInterval(this.timer);
    const closed = new Promise((resolve) => this.worker.once("exit", resolve));
    this.worker.postMessage("close");
    await Promise.race([closed, new Promise((resolve) => setTimeout(resolve, CLOSED_WITHIN_MS))]);
  }
}
