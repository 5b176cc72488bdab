/** One scan or spectrum, followed through what the scheduler publishes. Pure: packets in, an outcome out. */

import { ScopeState } from "./generated/control_pb.js";

export type Outcome =
  | "completed"
  /** The microscope says that it was stopped. */
  | "interrupted"
  /** The microscope is free and there is nothing: it was started anew in the middle, say. */
  | "vanished"
  /** The results can't be those asked for: a person at the panel has moved the frame, say. */
  | "another";

/**
 * The state `busy`, then results, then FREE. While a connection was lost the cache may have kept the results and not
 * `busy`: then they are taken for ours, too.
 */
export class Cycle<T> {
  begun = false;
  outcome: Outcome | undefined;
  readonly results: T[] = [];
  private other = false;

  /**
   * @param sinceNs what is not newer belongs to something earlier.
   * @param resumed it was asked for in an earlier life of ours, or control was lost: another may have measured since.
   */
  constructor(private readonly busy: ScopeState, private readonly sinceNs: bigint, private resumed = false) {}

  /** Another component may measure from now on. */
  controlWasLost(): void {
    this.resumed = true;
  }

  onState(state: ScopeState, timeNs: bigint | undefined): void {
    if (this.isOver(timeNs)) return;
    if (state === this.busy) {
      this.results.length = 0; // what came before this began belongs to another
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
