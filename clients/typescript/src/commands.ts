/** Sends commands to the microscope, repeated with the same id until an answer arrives; a refusal is thrown. */

import { create, toBinary } from "@bufbuild/protobuf";
import { type Deadline, earlier } from "./conditions.js";
import type { ControlHold } from "./control.js";
import { NoResponse, Refused, ResponseDetail, responseName } from "./errors.js";
import type { Response } from "./frames.js";
import { ActionMsgSchema, ControlRequest, ControlResponse, ScopeState } from "./generated/control_pb.js";
import type { Link } from "./link.js";

const PATIENCE_S = 60; // longest absence of a translator
const RETRY_S = 1; // before the next attempt at an unreachable microscope, if nothing is published in between
const SETTLED_WITHIN_S = 2; // a setting that changed something is published within this time
const ASK_BUSY_AGAIN_S = 25; // in case the state FREE is never received
const NOT_IN_CONTROL: readonly number[] = [ControlResponse.REP_NOT_IN_CONTROL, ControlResponse.REP_WRONG_CONTROL_MODE];
const { REP_SUCCESS, REP_NO_RESPONSE, REP_NOT_FREE } = ControlResponse;

export function encodeAction(name: string): Uint8Array {
  return toBinary(ActionMsgSchema, create(ActionMsgSchema, { action: name }));
}

/** Whether the outcome of the request is unknown. */
function isUnanswered({ code, detail }: Response): boolean {
  return code === REP_NO_RESPONSE || detail === ResponseDetail.NOT_SENT || detail === ResponseDetail.OUTCOME_UNKNOWN;
}

export class Commands {
  constructor(private readonly link: Link, private readonly control: ControlHold) {}

  /** Repeat a request until it succeeds. The caller holds control; after a loss this waits for control. Throws Refused, NoResponse. */
  async ask(kind: number, object: Uint8Array, deadline: Deadline): Promise<Response> {
    let id = this.link.requests.nextId();
    for (;;) {
      await this.control.regain(deadline);
      const states = this.link.count("ScopeStateMsg");
      const response = await this.send(kind, object, id, deadline);
      if (response.code === REP_SUCCESS) return response;
      if (!isUnanswered(response)) { // otherwise it may have been carried out: repeat with the same id
        await this.getOver(kind, response, states, deadline);
        id = this.link.requests.nextId();
      }
    }
  }

  /** Change a setting, and wait until its `message` is published and the tip has stopped moving. */
  async set(kind: number, object: Uint8Array, message: string, deadline: Deadline): Promise<void> {
    const count = this.link.count(message);
    await this.ask(kind, object, deadline);
    const isPublished = await this.link.wait(() => this.link.count(message) !== count, earlier(SETTLED_WITHIN_S, deadline));
    if (isPublished) await this.link.wait(() => this.link.state !== ScopeState.SS_MOVING, deadline);
  }

  /**
   * Send a request and repeat it with the same id while the microscope is silent, so that it is executed once.
   *
   * @param isSeen whether the effect of the request is observed, which counts as an answer.
   * @returns the answer; one without an outcome only if control was lost before there was any.
   */
  async send(kind: number, object: Uint8Array, id: string, deadline: Deadline, isSeen = () => false): Promise<Response> {
    const { link, control } = this;
    const giveUp = earlier(PATIENCE_S, deadline);
    await link.wait(() => link.count("ScopeStateMsg") > 0, giveUp); // a microscope without a published state refuses
    for (let isRepeated = false; ; isRepeated = true) {
      const response = await link.requests.request(kind, object, id, deadline);
      if (isRepeated && NOT_IN_CONTROL.includes(response.code)) { // now; the outcome of the earlier attempt is still unknown
        control.lost(response.reason);
        return { ...response, code: REP_NO_RESPONSE };
      }
      if (!isUnanswered(response) || control.wasLost) return response;
      if (isSeen()) return { ...response, code: REP_SUCCESS };
      if (performance.now() >= giveUp) {
        throw new NoResponse(`request ${kind}`, `the microscope does not answer: ${response.reason}`, response.detail);
      }
      if (!isRepeated) link.log("WARNING", `the microscope does not answer request ${kind} (${response.reason}); asking again`);
      const news = this.news();
      await link.wait(() => this.news() !== news, earlier(RETRY_S, giveUp));
    }
  }

  /** Wait until the cause of a refusal is gone, or throw Refused. */
  async getOver(kind: number, response: Response, states: number, deadline: Deadline): Promise<void> {
    if (isUnanswered(response)) return; // control is lost; the next attempt waits for it
    if (NOT_IN_CONTROL.includes(response.code)) this.control.lost(response.reason || responseName(response.code));
    else if (response.code === REP_NOT_FREE) await this.waitFree(states, deadline);
    else throw new Refused(ControlRequest[kind] ?? `request ${kind}`, response.code, response.reason, response.detail);
  }

  /** Wait for a state FREE newer than `states`, with a time limit in case that packet is lost. */
  private async waitFree(states: number, deadline: Deadline): Promise<void> {
    const isFree = () => this.link.state === ScopeState.SS_FREE && this.link.count("ScopeStateMsg") !== states;
    await this.link.wait(isFree, earlier(this.link.state === ScopeState.SS_FREE ? RETRY_S : ASK_BUSY_AGAIN_S, deadline));
    if (performance.now() >= deadline) throw new NoResponse("the microscope was not free in time", ScopeState[this.link.state], ResponseDetail.NOT_SENT);
  }

  private news(): number {
    return this.link.count("ScopeStateMsg") + this.link.count("ControlState");
  }
}
