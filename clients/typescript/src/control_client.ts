/** Sends requests to the scheduler: each has an id, is repeated with it until it is answered, and is executed once. */

import { randomBytes } from "node:crypto";
import { Dealer } from "zeromq";
import { type Conditions, type Deadline, earlier } from "./conditions.js";
import { ConfigError, ExperimentEnded, NoResponse, ResponseDetail } from "./errors.js";
import { decodeResponse, encodeRequest, type Response } from "./frames.js";
import { curveOptions, type Launch, routingId } from "./launch.js";
import { SOCKET_OPTIONS } from "./subscription.js";

const CLOCK_REQUEST = 101;
const OTHER_RUN = 100;
const LONGEST_RESPONSE = 1024 * 1024;
/** Longer than the scheduler waits for the microscope, so that its NO_RESPONSE arrives before the timeout. */
const LONGER_THAN_THE_SCHEDULER = 1.2;

/** A DEALER socket with the identity of this component; see "Requests and responses" of the wire format. */
export class ControlClient {
  /** Whether the scheduler is there, and how often a connection to it was made. */
  connected = false;
  connections = 0;
  private readonly socket: Dealer;
  private readonly session: string;
  private readonly answers = new Map<string, Response | undefined>();
  private readonly empty = Buffer.alloc(0);
  private requests = 0;
  private sending: Promise<unknown> = Promise.resolve();

  constructor(
    private readonly launch: Launch,
    private readonly address: string,
    private readonly conditions: Conditions,
  ) {
    this.session = [launch.run, randomBytes(4).toString("hex")].filter(Boolean).join("-");
    this.socket = new Dealer({
      ...SOCKET_OPTIONS,
      routingId: routingId(launch.name, launch.keys),
      sendHighWaterMark: 0,
      receiveHighWaterMark: 0,
      maxMessageSize: LONGEST_RESPONSE,
      heartbeatInterval: 2000,
      heartbeatTimeout: 8000,
      heartbeatTimeToLive: 8000,
      ...curveOptions(launch.keys, address),
    });
    this.socket.events.on("handshake", () => this.onConnected());
    this.socket.events.on("disconnect", () => this.onDisconnected());
    this.socket.connect(address);
    void this.receive();
  }

  /** Return an id for a request, unique over all lives of this component. */
  nextId(): string {
    return `${this.launch.name}/${this.session}/${++this.requests}`;
  }

  /** Send a request without waiting for its answer. */
  sendOnly(kind: number, object: Uint8Array = this.empty): void {
    this.send(encodeRequest(kind, object, this.nextId()));
  }

  /**
   * Send a request and return its answer, also a refusal.
   *
   * Throws NoResponse, ExperimentEnded, ConfigError (the scheduler belongs to another run), StopRequested.
   */
  async request(kind: number, object: Uint8Array = this.empty, id = this.nextId(), deadline: Deadline = Infinity): Promise<Response> {
    const frames = encodeRequest(kind, object, id);
    const { request_timeout_s: timeoutS, request_retries: retries } = this.launch;
    this.answers.set(id, undefined);
    const answer = () => this.answers.get(id);
    try {
      let wasSent = false;
      for (let tries = 0; tries <= retries; ) {
        if (!(await this.conditions.wait(() => this.connected, earlier(timeoutS * (1 + retries), deadline)))) {
          const detail = wasSent ? ResponseDetail.OUTCOME_UNKNOWN : ResponseDetail.NOT_SENT;
          throw new NoResponse(`request ${kind}`, "the scheduler does not answer; is the experiment running?", detail);
        }
        const connections = this.connections;
        this.send(frames);
        wasSent = true;
        const isAnswered = () => answer() !== undefined || connections !== this.connections || !this.connected;
        await this.conditions.wait(isAnswered, earlier(timeoutS * LONGER_THAN_THE_SCHEDULER, deadline));
        const response = answer();
        if (response) return this.checked(response);
        if (performance.now() >= deadline) break;
        if (connections !== this.connections || !this.connected) continue; // a restart of the scheduler does not count as silence
        tries += 1;
        this.reconnect();
      }
    } finally {
      this.answers.delete(id);
    }
    throw new NoResponse(`request ${kind}`, "it was not answered; it may or may not have been carried out");
  }

  /** Send the waiting requests, and close. */
  async close(): Promise<void> {
    await this.sending;
    this.socket.close();
  }

  private checked(response: Response): Response {
    if (response.detail === ResponseDetail.EXPERIMENT_ENDED) {
      this.conditions.fail(new ExperimentEnded("the experiment has ended"));
      throw this.conditions.over;
    }
    return response;
  }

  private send(frames: readonly Uint8Array[]): void {
    if (!this.connected) return;
    this.sending = this.sending.then(() => this.socket.send([this.empty, ...frames])).catch(() => undefined);
  }

  /** Replace a connection that is established but without answers: it would never recover. */
  private reconnect(): void {
    this.onDisconnected();
    this.socket.disconnect(this.address);
    this.socket.connect(this.address);
  }

  private onConnected(): void {
    this.connected = true;
    this.connections += 1;
    this.sendOnly(CLOCK_REQUEST); // its id contains the client's name and run
    this.conditions.notify();
  }

  private onDisconnected(): void {
    this.connected = false;
    this.conditions.notify();
  }

  private async receive(): Promise<void> {
    for await (const [delimiter, ...frames] of this.socket) {
      if (delimiter?.length !== 0 || !frames.length) continue; // empty: the scheduler probes whether this client is alive
      try {
        this.take(decodeResponse(frames));
      } catch {
        continue; // not an answer; the request is repeated
      }
    }
  }

  private take(response: Response): void {
    if (response.code === OTHER_RUN) {
      this.conditions.fail(new ConfigError(`${this.address}: ${response.reason}`));
    } else if (this.answers.has(response.id)) {
      this.answers.set(response.id, response);
      this.conditions.notify();
    } // otherwise a late answer to a request that was given up
  }
}
