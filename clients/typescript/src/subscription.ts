/** Receives the packets of one publisher: each once, and missed packets before newer ones. */

import { XSubscriber } from "zeromq";
import { decodePacket, KILL, type Packet } from "./frames.js";
import { curveOptions, type Keys } from "./launch.js";

const LONGEST_PACKET = 256 * 1024 * 1024;
const MOST_ENVELOPES = 10_000;
const SUBSCRIBE = 1;
const UNSUBSCRIBE = 0;

/** The options of all sockets: a lost peer is noticed within seconds, and reconnected at once. */
export const SOCKET_OPTIONS = {
  linger: 200,
  tcpKeepalive: 1,
  tcpKeepaliveIdle: 2,
  tcpKeepaliveInterval: 2,
  tcpKeepaliveCount: 3,
  reconnectInterval: 20,
  reconnectMaxInterval: 200,
} as const;

export interface SubscriptionHandlers {
  onPacket(packet: Packet): void;
  onCaughtUp(): void;
  onKill(): void;
  onDropped(why: string): void;
}

/** A connection to one publisher. Unlike SUB, XSUB sends the marker of a replay unchanged. */
export class Subscription {
  private readonly socket: XSubscriber;
  private readonly prefixes: readonly string[];
  private readonly newestOf = new Map<string, bigint>();
  private newestNs = -1n;
  private connections = 0;
  private topic: Buffer | undefined;
  private marker: Buffer | undefined;
  private sending: Promise<unknown> = Promise.resolve();

  /** @param prefixes of the wanted envelopes; null: all. The signal KILL is always included. */
  constructor(
    private readonly name: string,
    private readonly address: string,
    prefixes: readonly string[] | null,
    keys: Keys | null,
    private readonly handlers: SubscriptionHandlers,
  ) {
    const wanted = prefixes ?? [""];
    this.prefixes = wanted.some((prefix) => KILL.startsWith(prefix)) ? wanted : [...wanted, KILL];
    this.socket = new XSubscriber({ ...SOCKET_OPTIONS, maxMessageSize: LONGEST_PACKET, ...curveOptions(keys, address) });
    this.socket.events.on("handshake", () => this.askForMissed());
    for (const prefix of this.prefixes) this.send(SUBSCRIBE, Buffer.from(prefix));
    this.socket.connect(address);
    void this.receive();
  }

  close(): void {
    this.socket.close();
  }

  /** After each connection, request packets newer than the newest received one. */
  private askForMissed(): void {
    this.forgetMarker();
    this.topic = Buffer.from(`\0replay/${this.name}/${this.connections++}`);
    this.marker = Buffer.concat([this.topic, Buffer.from(["", this.newestNs, ...this.prefixes].join("\0"))]);
    this.send(SUBSCRIBE, this.marker);
  }

  /** Unsubscribe: otherwise the socket would repeat the request at its next connection. */
  private forgetMarker(): void {
    if (this.marker) this.send(UNSUBSCRIBE, this.marker);
    this.marker = undefined;
  }

  private send(kind: number, topic: Buffer): void {
    const frame = Buffer.concat([Buffer.of(kind), topic]);
    this.sending = this.sending.then(() => this.socket.send(frame)).catch(() => undefined); // closed: no more subscriptions are needed
  }

  private async receive(): Promise<void> {
    for await (const frames of this.socket) {
      const packet = this.interpret(frames);
      if (packet) this.handlers.onPacket(packet);
    }
  }

  private interpret(frames: Buffer[]): Packet | undefined {
    let contents = frames;
    if (frames[0]?.[0] === 0) {
      if (!this.marker || !this.topic?.equals(frames[0])) return undefined; // of an earlier connection or another subscriber
      contents = frames.slice(1);
      if (!contents.length) {
        this.forgetMarker();
        this.handlers.onCaughtUp();
        return undefined;
      }
    } else if (frames.length === 1 && frames[0]?.toString() === KILL) {
      this.handlers.onKill();
      return undefined;
    }
    try {
      const packet = decodePacket(contents);
      return this.isNew(packet) ? packet : undefined;
    } catch (error) {
      this.handlers.onDropped(`dropped a packet from ${this.address}: ${String(error)}`);
      return undefined;
    }
  }

  private isNew({ envelope, timeNs }: Packet): boolean {
    if (!this.prefixes.some((prefix) => envelope.startsWith(prefix))) return false;
    if (timeNs === undefined) return true;
    if (timeNs <= (this.newestOf.get(envelope) ?? -1n)) return false;
    this.newestOf.set(envelope, timeNs);
    if (this.newestOf.size > MOST_ENVELOPES) this.newestOf.delete(this.newestOf.keys().next().value!);
    if (timeNs > this.newestNs) this.newestNs = timeNs;
    return true;
  }
}
