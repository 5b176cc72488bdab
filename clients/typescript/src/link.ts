/** A component's connections to its experiment, and the newest of each state that was published. */

import { fromBinary } from "@bufbuild/protobuf";
import { Conditions, type Deadline, earlier } from "./conditions.js";
import { ControlClient } from "./control_client.js";
import { ConfigError, ExperimentEnded, NoResponse } from "./errors.js";
import type { Packet } from "./frames.js";
import { ScopeState, ScopeStateMsgSchema } from "./generated/control_pb.js";
import { ZCtrlParametersSchema, type ZCtrlParameters } from "./generated/feedback_pb.js";
import type { Launch } from "./launch.js";
import {
  type ControlState, decodeControlState, decodePlace, decodeScanParameters, Scan, ScanLines, type ScanParameters, Spectrum, type XY,
} from "./model.js";
import { Subscription } from "./subscription.js";

/** A packet, decoded. */
export type Published =
  | { readonly name: "Scan2d"; readonly value: Scan; readonly packet: Packet }
  | { readonly name: "Spec1d"; readonly value: Spectrum; readonly packet: Packet }
  | { readonly name: "ScanLines"; readonly value: ScanLines; readonly packet: Packet }
  | { readonly name: "ScopeStateMsg"; readonly value: ScopeState; readonly packet: Packet }
  | { readonly name: "ControlState"; readonly value: ControlState; readonly packet: Packet }
  | { readonly name: "ScanParameters2d"; readonly value: ScanParameters; readonly packet: Packet }
  | { readonly name: "ZCtrlParameters"; readonly value: ZCtrlParameters; readonly packet: Packet }
  | { readonly name: "ProbePosition"; readonly value: XY | undefined; readonly packet: Packet }
  | { readonly name: ""; readonly value: undefined; readonly packet: Packet };

export type Listener = (published: Published, ours: boolean) => void;
const STATES = ["ScopeStateMsg", "ControlState", "ScanParameters2d", "ZCtrlParameters", "ProbePosition"] as const;
type StateName = (typeof STATES)[number];

/** Return the name of the message in a packet: its envelope up to the first underscore. */
export function messageOf(envelope: string): string {
  return envelope.split("_", 1)[0]!;
}

/** Decode a packet; the name is empty for an unknown message. Throws WireError, InvalidValue. */
export function decode(packet: Packet): Published {
  const { payload } = packet;
  const name = messageOf(packet.envelope);
  switch (name) {
    case "Scan2d": return { name, value: Scan.decode(packet), packet };
    case "Spec1d": return { name, value: Spectrum.decode(packet), packet };
    case "ScanLines": return { name, value: ScanLines.decode(payload), packet };
    case "ScopeStateMsg": return { name, value: fromBinary(ScopeStateMsgSchema, payload).scopeState ?? ScopeState.SS_UNDEFINED, packet };
    case "ControlState": return { name, value: decodeControlState(payload), packet };
    case "ScanParameters2d": return { name, value: decodeScanParameters(payload), packet };
    case "ZCtrlParameters": return { name, value: fromBinary(ZCtrlParametersSchema, payload), packet };
    case "ProbePosition": return { name, value: decodePlace(payload), packet };
    default: return { name: "", value: undefined, packet };
  }
}

export class Link {
  readonly conditions = new Conditions();
  readonly listeners = new Set<Listener>();
  /** When the newest packet of the scheduler was published. */
  newestNs = -1n;
  private readonly newest = new Map<StateName, unknown>();
  private readonly counts = new Map<string, number>();
  private readonly control: ControlClient | undefined;
  private readonly subscriptions: readonly Subscription[];
  private readonly caughtUp = new Set<string>();

  constructor(readonly launch: Launch) {
    const { sockets, name, envelopes, keys } = launch;
    if (sockets.control) this.control = new ControlClient(launch, sockets.control, this.conditions);
    const followed = sockets.control ? [...STATES, "Scan2d", "Spec1d"] : []; // needed by commands and measurements
    const wanted = envelopes && [...envelopes, ...followed.filter((one) => !envelopes.some((prefix) => one.startsWith(prefix)))];
    this.subscriptions = sockets.subscribe.map((address, index) => new Subscription(name, address, wanted, keys, {
      onPacket: (packet) => this.take(packet, index === 0),
      onCaughtUp: () => this.change(() => this.caughtUp.add(address)),
      onKill: () => this.conditions.fail(new ExperimentEnded("the experiment has ended")),
      onDropped: (why) => this.log("WARNING", why),
    }));
  }

  /** The sender of requests. Throws ConfigError: this component has no address of the scheduler. */
  get requests(): ControlClient {
    if (!this.control) throw new ConfigError(`${this.launch.name} was given no scheduler to ask`);
    return this.control;
  }

  /** The newest published states; undefined before the first. */
  get state(): ScopeState { return (this.newest.get("ScopeStateMsg") as ScopeState | undefined) ?? ScopeState.SS_UNDEFINED; }
  get controlState(): ControlState | undefined { return this.newest.get("ControlState") as ControlState | undefined; }
  get scanParameters(): ScanParameters | undefined { return this.newest.get("ScanParameters2d") as ScanParameters | undefined; }
  get feedback(): ZCtrlParameters | undefined { return this.newest.get("ZCtrlParameters") as ZCtrlParameters | undefined; }
  get probePositionM(): XY | undefined { return this.newest.get("ProbePosition") as XY | undefined; }

  /** Whether the experiment file lists an envelope for this component. */
  isListenedTo(envelope: string): boolean {
    return this.launch.envelopes?.some((prefix) => envelope.startsWith(prefix)) ?? true;
  }

  /** Return the number of received packets of a message. */
  count(name: string): number {
    return this.counts.get(name) ?? 0;
  }

  wait(condition: () => boolean, deadline: Deadline = Infinity): Promise<boolean> {
    return this.conditions.wait(condition, deadline);
  }

  /** Wait without limit while the scheduler is away, otherwise for at most `withinS`. */
  async waitConnected(done: () => boolean, withinS: number, deadline: Deadline): Promise<boolean> {
    while (!done()) {
      if (!(await this.wait(() => this.requests.connected || done(), deadline))) return false;
      const { connections } = this.requests;
      const isSettled = () => done() || !this.requests.connected || this.requests.connections !== connections;
      if (!(await this.wait(isSettled, earlier(withinS, deadline)))) return false;
    }
    return true;
  }

  /** Wait until all packets of the scheduler's cache have arrived. */
  async waitCaughtUp(deadline: Deadline = Infinity): Promise<void> {
    const [scheduler] = this.launch.sockets.subscribe;
    if (scheduler === undefined) return;
    if (!(await this.wait(() => this.caughtUp.has(scheduler), deadline))) throw new NoResponse("joining", "the scheduler does not answer; is the experiment running?");
  }

  /** Write a line that the supervisor puts into the log of the experiment. */
  log(level: "DEBUG" | "INFO" | "WARNING" | "ERROR", text: string): void {
    process.stderr.write(`${level} ${text}\n`);
  }

  async close(): Promise<void> {
    for (const subscription of this.subscriptions) subscription.close();
    await this.control?.close();
  }

  private take(packet: Packet, ours: boolean): void {
    let published: Published;
    try {
      published = decode(packet);
    } catch (error) {
      this.log("WARNING", `${this.launch.name}: a ${packet.envelope} can't be read: ${String(error)}`);
      return;
    }
    this.change(() => {
      if (ours) this.remember(published);
      for (const listener of [...this.listeners]) listener(published, ours);
    });
  }

  private remember({ name, value, packet }: Published): void {
    if (packet.timeNs !== undefined && packet.timeNs > this.newestNs) this.newestNs = packet.timeNs;
    this.counts.set(name, this.count(name) + 1);
    if ((STATES as readonly string[]).includes(name)) this.newest.set(name as StateName, value);
  }

  private change(what: () => void): void {
    what();
    this.conditions.notify();
  }
}
