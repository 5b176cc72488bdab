import { ControlResponse } from "./generated/control_pb.js";

/** The base of all errors of this package. */
export class AfspmError extends Error {
  override get name(): string {
    return this.constructor.name;
  }
}

/** The launch line, a key or an address can't work: a restart would fail the same way. */
export class ConfigError extends AfspmError {}

/** Bytes from a peer that violate the wire format. */
export class WireError extends AfspmError {}

/** A value that has no meaning here: NaN, an empty region, a unit of the wrong dimension. */
export class InvalidValue extends AfspmError {}

/** What a program must know of a response beside its code. */
export enum ResponseDetail {
  NONE = 0,
  /** The request was not sent and may be repeated. */
  NOT_SENT = 1,
  /** The request may or may not have been carried out. */
  OUTCOME_UNKNOWN = 2,
  EXPERIMENT_ENDED = 3,
}

/** Base of the errors of a request. */
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

/** A refusal by the scheduler, a limit or the microscope. */
export class Refused extends RequestError {}

/** Control was not granted in time, or the problem to solve is not flagged. */
export class ControlLost extends RequestError {}

/** No answer arrived in time. */
export class NoResponse extends RequestError {
  constructor(what: string, reason: string, detail = ResponseDetail.OUTCOME_UNKNOWN) {
    super(what, ControlResponse.REP_NO_RESPONSE, reason, detail);
  }
}

/** The same measurement failed repeatedly without a known reason: a person has to look. */
export class MeasurementFailed extends AfspmError {}

/** The experiment has ended: the scheduler takes no more requests. */
export class ExperimentEnded extends AfspmError {}

/** Standard input has ended: the supervisor stops this process, or is gone. */
export class StopRequested extends AfspmError {}

export function responseName(code: number): string {
  return ControlResponse[code] ?? String(code);
}
