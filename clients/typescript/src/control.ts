/** Control: requesting it, waiting for it, noticing its loss, releasing it. */

import { type Deadline, deadlineIn, earlier } from "./conditions.js";
import { ControlLost, InvalidValue, NoResponse, Refused } from "./errors.js";
import type { Response } from "./frames.js";
import { ControlRequest, ControlResponse } from "./generated/control_pb.js";
import type { Link, Published } from "./link.js";
import { ControlMode } from "./model.js";

const ASK_AGAIN_S = 10; // in case a published control state is not received
const MAY_COME: readonly number[] = [
  ControlResponse.REP_ALREADY_UNDER_CONTROL, ControlResponse.REP_WRONG_CONTROL_MODE, ControlResponse.REP_WRONG_EXP_PROBLEM,
];

/**
 * This component's hold on control. Answers of the scheduler grant control; its published state revokes it, once a
 * state has named this component: a state from before the grant may still be in transit.
 */
export class ControlHold {
  held = false;
  /** The reason of the loss of control, for a person. */
  whyLost = "";
  private wasNamed = false;
  private depth = 0;
  private solving = 0;
  private isKept = false;

  constructor(private readonly link: Link) {
    link.listeners.add((published, ours) => ours && this.take(published));
  }

  /** Whether control is wanted and not held. */
  get wasLost(): boolean {
    return this.depth > 0 && !this.held;
  }

  /** Hold control while `body` runs; a nested call shares the control of the outer one. */
  async hold<T>(body: () => Promise<T>, solving = 0, deadline: Deadline = Infinity): Promise<T> {
    await this.acquire(solving, deadline);
    try {
      return await body();
    } finally {
      await this.relinquish();
    }
  }

  /** Have control until `relinquish` was called as often. */
  async acquire(solving: number, deadline: Deadline): Promise<void> {
    if (this.depth === 0) this.solving = solving;
    else if (solving && solving !== this.solving) throw new InvalidValue(`control is held to solve problem ${this.solving}, not ${solving}`);
    this.depth += 1;
    try {
      await this.regain(deadline);
    } catch (error) {
      await this.relinquish();
      throw error;
    }
  }

  /** Hold control until `giveUp` is called; a second call only checks that it is held. */
  async keep(solving: number, deadline: Deadline): Promise<void> {
    if (!this.isKept) await this.acquire(solving, deadline);
    else if (this.solving === solving) await this.regain(deadline);
    else await this.change(solving, deadline);
    this.isKept = true;
  }

  /** Hold control for another problem than now, if the scheduler allows it. */
  private async change(solving: number, deadline: Deadline): Promise<void> {
    const response = await this.link.requests.request(ControlRequest.REQ_REQUEST_CTRL, Uint8Array.of(solving), undefined, deadline);
    if (response.code !== ControlResponse.REP_SUCCESS) throw new Refused("control", response.code, response.reason, response.detail);
    this.solving = solving;
    this.held = true;
  }

  async giveUp(): Promise<void> {
    if (this.isKept) await this.relinquish();
    this.isKept = false;
  }

  async relinquish(): Promise<void> {
    if (this.depth > 0) this.depth -= 1;
    if (this.depth === 0) await this.release();
  }

  /** Return once in control: request it, wait for the control state to change, and request again. */
  async regain(deadline: Deadline): Promise<void> {
    const { link } = this;
    let reported = "";
    let refusal: Response | undefined;
    while (!this.held) {
      const count = link.count("ControlState");
      const { connections } = link.requests;
      const response = await this.ask(deadline).catch((error: unknown) => {
        if (refusal && error instanceof NoResponse && performance.now() >= deadline) return refusal; // the newest published state
        throw error;
      });
      if (!response) break;
      refusal = response;
      const obstacle = response.reason || this.obstacle();
      if (obstacle !== reported) link.log("INFO", `${link.launch.name} waits for control: ${obstacle}`);
      reported = obstacle;
      const mayAsk = () => link.requests.connections !== connections || (link.count("ControlState") !== count && (this.isSolved() || !this.obstacle()));
      await link.wait(mayAsk, earlier(ASK_AGAIN_S, deadline));
      if (performance.now() >= deadline) throw new ControlLost("control was not given in time", response.code, response.reason, response.detail);
    }
  }

  /** Release control that an earlier life of this component held and that is not wanted now. */
  releaseInherited(): void {
    if (!this.depth && !this.held && this.link.controlState?.holder === this.link.launch.name) this.link.requests.sendOnly(ControlRequest.REQ_RELEASE_CTRL);
  }

  /** Note the scheduler's answer that this component is not in control. */
  lost(why: string): void {
    this.held = false;
    this.whyLost = why;
  }

  /** Release control if it is held. */
  async release(): Promise<void> {
    if (!this.held) return;
    this.held = false;
    if (this.link.conditions.over) this.link.requests.sendOnly(ControlRequest.REQ_RELEASE_CTRL);
    else await this.link.requests.request(ControlRequest.REQ_RELEASE_CTRL, undefined, undefined, deadlineIn(this.link.launch.request_timeout_s)).catch(() => undefined);
  }

  /** Request control once. Return a refusal that may pass with time; undefined: control is granted. */
  private async ask(deadline: Deadline): Promise<Response | undefined> {
    const { link, solving } = this;
    const response = await link.requests.request(ControlRequest.REQ_REQUEST_CTRL, Uint8Array.of(solving), undefined, deadline);
    if (response.code === ControlResponse.REP_SUCCESS) {
      this.held = true;
      this.wasNamed = link.controlState?.holder === link.launch.name;
      return undefined;
    }
    if (!MAY_COME.includes(response.code)) throw new Refused("control", response.code, response.reason, response.detail);
    if (response.code === ControlResponse.REP_WRONG_EXP_PROBLEM && this.isSolved()) {
      throw new ControlLost(`problem ${solving} is not flagged: there is nothing to solve`, response.code, response.reason, response.detail);
    }
    return response;
  }

  private isSolved(): boolean {
    return this.solving !== 0 && !this.link.controlState?.problems.includes(this.solving);
  }

  /** Return the reason why control is withheld, for a person; empty without one. */
  private obstacle(): string {
    const state = this.link.controlState;
    if (!state) return "";
    if (state.mode === ControlMode.CM_MANUAL) return "the mode is MANUAL";
    if (this.solving ? !state.problems.includes(this.solving) : state.problems.length) return `problems ${state.problems.join(", ")} are flagged`;
    return state.holder && state.holder !== this.link.launch.name ? `${state.holder} is in control` : "";
  }

  private take(published: Published): void {
    if (published.name !== "ControlState" || !this.held) return;
    if (published.value.holder === this.link.launch.name) this.wasNamed = true;
    else if (this.wasNamed) this.lost(this.obstacle() || "it was revoked");
  }
}
