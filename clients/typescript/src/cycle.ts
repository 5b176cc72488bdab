/** One scan or spectrum, followed by published packets. Pure: takes packets, returns an outcome. */

import { ScopeState } from "./generated/control_pb.js";

export type Outcome =
  | "completed"
  /** The microscope published an interruption. */
  | "interrupted"
  /** The microscope is free without a result, for example after a restart of the translator. */
  | "vanished"
  /** The results do not match the request, for example after a person moved the frame. */
  | "another";

/**
 * The state `busy`, then results, then FREE. After a lost connection the cache may hold the results but not
 * `busy`: such results count, too.
 */
export class Cycle<T> {
  begun = false;
  outcome: Outcome | undefined;
  readonly results: T[] = [];
  private other = false;

  /**
   * @param sinceNs packets up to this time belong to an earlier measurement.
   * @param resumed it was requested in an earlier life, or control was lost: another component may have measured since.
   */
  constructor(private readonly busy: ScopeState, private readonly sinceNs: bigint, private resumed = false) {}

  /** Note that another component may measure from now on. */
  controlWasLost(): void {
    this.resumed = true;
  }

  onState(state: ScopeState, timeNs: bigint | undefined): void {
    if (this.isOver(timeNs)) return;
    if (state === this.busy) {
      this.results.length = 0; // results from before the start belong to another measurement
      this.other = false;
      this.begun = true;
    } else if (this.begun && state === ScopeState.SS_INTERRUPTED) {
      this.outcome = "interrupted";
    } else if (this.begun && state === ScopeState.SS_FREE) {
      this.outcome = this.results.length ? "completed" : this.other ? "another" : "vanished";
    }
  }

  onResult(result: T, fits: boolean, timeNs: bigint | undefined): void {
    if (this.isOver(timeNs)) return;
    if (fits) {
      this.begun = true;
      this.results.push(result);
    } else {
      this.other ||= this.begun;
    }
  }

  private isOver(timeNs: bigint | undefined): boolean {
    return this.outcome !== undefined || (timeNs === undefined ? this.resumed : timeNs <= this.sinceNs);
  }
}
