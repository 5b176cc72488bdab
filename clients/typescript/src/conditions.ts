/** Waiting: conditions that are tried whenever something has arrived. */

interface Waiting {
  readonly condition: () => boolean;
  readonly settle: (met: boolean) => void;
  readonly fail: (error: Error) => void;
}

/** A moment in milliseconds of `performance.now()`; Infinity: never. */
export type Deadline = number;

/** Return the moment when a timeout is over; undefined: never. */
export function deadlineIn(seconds: number | undefined): Deadline {
  return seconds === undefined ? Infinity : performance.now() + seconds * 1000;
}

/** Return the end of a timeout, or `deadline` if that comes first. */
export function earlier(seconds: number, deadline: Deadline): Deadline {
  return Math.min(deadlineIn(seconds), deadline);
}

export class Conditions {
  private readonly waiting = new Set<Waiting>();
  /** Why there is nothing more to wait for. */
  over: Error | undefined;

  /** Wait until the condition holds; false if the deadline comes first. Rejects with `over`. */
  async wait(condition: () => boolean, deadline: Deadline = Infinity): Promise<boolean> {
    if (this.over) throw this.over;
    if (condition()) return true;
    const left = deadline - performance.now();
    if (left <= 0) return false;
    return await new Promise<boolean>((resolve, reject) => {
      // a timer may fire a moment early: then the deadline would not have come
      const timer = left < 2 ** 31 ? setTimeout(() => waiting.settle(false), Math.ceil(left) + 1) : undefined;
      const done = (finish: () => void) => {
        clearTimeout(timer);
        this.waiting.delete(waiting);
        finish();
      };
      const waiting: Waiting = { condition, settle: (met) => done(() => resolve(met)), fail: (error) => done(() => reject(error)) };
      this.waiting.add(waiting);
    });
  }

  /** Try all conditions: something has arrived. */
  notify(): void {
    for (const one of [...this.waiting]) if (one.condition()) one.settle(true);
  }

  /** End all waiting, with a reason. */
  fail(error: Error): void {
    this.over ??= error;
    for (const one of [...this.waiting]) one.fail(this.over);
  }
}
