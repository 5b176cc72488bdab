import { ControlResponse } from "./generated/control_pb.js";

/** The base of all errors of this package. */
export class AfspmError extends Error {
  override get name(): string {
    return this.constructor.name;
  }
}

/** The launch line, a key or an address can't work: a restart would fail the same way. */
export class ConfigError extends AfspmError {}

/** Bytes from a peer that are not what the wire format says. */
export class WireError extends AfspmError {}

/** A value that has no meaning here: NaN, an empty region, a unit of the wrong dimension. */
export class InvalidValue extends AfspmError {}

/** What a program must know of a response beside its code. */
export enum ResponseDetail {
  NONE = 0,
  /** The request was not sent and may be asked again. */
  NOT_SENT = 1,
  /** The request may or may not have been carried out. */
  OUTCOME_UNKNOWN = 2,
  EXPERIMENT_ENDED = 3,
}

/** The base of what may come of a request. */
export class RequestError extends AfspmError {
  constructor(
    what: string,
    /** The number of the response, see `ControlResponse`. */
    readonly code: number,
    /** Why, for a person. */
    readonly reason: string,
    readonly detail: ResponseDetail,
  ) {
    super(`${what}: ${reason || responseName(code)} (${responseName(code)})`);
  }

  /** The name of the response, such as "REP_PARAM_ERROR". */
  get response(): string {
    return responseName(this.code);
  }
}

/** The scheduler, a limit or the microscope said no. */
export class Refused extends RequestError {}

/** Control was not given in time, or the problem to be solved is not flagged. */
export class ControlLost extends RequestError {}

/** Nobody answered, or not in time. */
export class NoResponse extends RequestError {
  constructor(what: string, reason: string, detail = ResponseDetail.OUTCOME_UNKNOWN) {
    super(what, ControlResponse.REP_NO_RESPONSE, reason, detail);
  }
}

/** The microscope fails again and again at the same measurement: a person should look. */
export class MeasurementFailed extends AfspmError {}

/** There is nothing more to ask. */
export class ExperimentEnded extends AfspmError {}

/** Standard input has ended: the supervisor wants this process to end, or is dead. */
export class StopRequested extends AfspmError {}

export function responseName(code: number): string {
  return ControlResponse[code] ?? String(code);
}
