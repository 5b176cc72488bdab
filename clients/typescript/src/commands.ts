/** Commands to the microscope, repeated with the same id until they are answered, and refused loudly. */

import { create, toBinary } from "@bufbuild/protobuf";
import { type Deadline, earlier } from "./conditions.js";
import type { ControlHold } from "./control.js";
import { NoResponse, Refused, ResponseDetail, responseName } from "./errors.js";
import type { Response } from "./frames.js";
import { ActionMsgSchema, ControlRequest, ControlResponse, ScopeState } from "./generated/control_pb.js";
import type { Link } from "./link.js";

const PATIENCE_S = 60; // that a translator may take to be there again
const RETRY_S = 1; // before an unreachable one is asked again, when nothing is published in between
const SETTLED_WITHIN_S = 2; // what was set is published, if it changed anything
const ASK_BUSY_AGAIN_S = 25; // should the state FREE never reach us
const NOT_IN_CONTROL: readonly number[] = [ControlResponse.REP_NOT_IN_CONTROL, ControlResponse.REP_WRONG_CONTROL_MODE];
const { REP_SUCCESS, REP_NO_RESPONSE, REP_NOT_FREE } = ControlResponse;

export function encodeAction(name: string): Uint8Array {
  return toBinary(ActionMsgSchema, create(ActionMsgSchema, { action: name }));
}

/** Whether it is not known if the microscope has carried out what it was asked for. */
function isUnanswered({ code, detail }: Response): boolean {
  return code === REP_NO_RESPONSE || detail === ResponseDetail.NOT_SENT || detail === ResponseDetail.OUTCOME_UNKNOWN;
}

export class Commands {
  constructor(private readonly link: Link, private readonly control: ControlHold) {}

  /** Ask until it succeeds. Control must be held around it; where it is lost it is waited for. Throws Refused, NoResponse. */
  async ask(kind: number, object: Uint8Array, deadline: Deadline): Promise<Response> {
    let id = this.link.requests.nextId();
    for (;;) {
      await this.control.regain(deadline);
      const states = this.link.count("ScopeStateMsg");
      const response = await this.send(kind, object, id, deadline);
      if (response.code === REP_SUCCESS) return response;
      if (!isUnanswered(response)) { // else it may have been carried out: the same id again
        await this.getOver(kind, response, states, deadline);
        id = this.link.requests.nextId();
      }
    }
  }

  /** Ask for a setting, and wait until its `message` is published and the tip has stopped moving. */
  async set(kind: number, object: Uint8Array, message: string, deadline: Deadline): Promise<void> {
    const count = this.link.count(message);
    await this.ask(kind, object, deadline);
    const isPublished = await this.link.wait(() => this.link.count(message) !== count, earlier(SETTLED_WITHIN_S, deadline));
    if (isPublished) await this.link.wait(() => this.link.state !== ScopeState.SS_MOVING, deadline);
  }

  /**
   * Ask once, with patience for a microscope that is silent: the same id has it executed once.
   *
   * @param isSeen whether what was asked for is seen to happen, which is as good as an answer.
   * @returns the answer; one without an outcome only if control was lost before there was any.
   */
  async send(kind: number, object: Uint8Array, id: string, deadline: Deadline, isSeen = () => false): Promise<Response> {
    const { link, control } = this;
    const giveUp = earlier(PATIENCE_S, deadline);
    await link.wait(() => link.count("ScopeStateMsg") > 0, giveUp); // a microscope that has not said a word would refuse
    for (let isRepeated = false; ; isRepeated = true) {
      const response = await link.requests.request(kind, object, id, deadline);
      if (isRepeated && NOT_IN_CONTROL.includes(response.code)) { // now; whether it was done before is still unknown
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

  /** After a refusal: wait for what stands in the way, or throw Refused. */
  async getOver(kind: number, response: Response, states: number, deadline: Deadline): Promise<void> {
    if (isUnanswered(response)) return; // control is lost, and waited for when it is asked again
    if (NOT_IN_CONTROL.includes(response.code)) this.control.lost(response.reason || responseName(response.code));
    else if (response.code === REP_NOT_FREE) await this.waitFree(states, deadline);
    else throw new Refused(ControlRequest[kind] ?? `request ${kind}`, response.code, response.reason, response.detail);
  }

  /** Wait until the microscope says that it is free, later than `states`; not for ever, should that get lost. */
  private async waitFree(states: number, deadline: Deadline): Promise<void> {
    const isFree = () => this.link.state === ScopeState.SS_FREE && this.link.count("ScopeStateMsg") !== states;
    await this.link.wait(isFree, earlier(this.link.state === ScopeState.SS_FREE ? RETRY_S : ASK_BUSY_AGAIN_S, deadline));
    if (performance.now() >= deadline) throw new NoResponse("the microscope was not free in time", ScopeState[this.link.state], ResponseDetail.NOT_SENT);
  }

  private news(): number {
    return this.link.count("ScopeStateMsg") + this.link.count("ControlState");
  }
}
