import { createInterface } from "node:readline";
import { ConfigError, ExperimentEnded, StopRequested } from "./errors.js";
import { Experiment } from "./experiment.js";
import { parseLaunch } from "./launch.js";

/** Exit codes: the reason why a process ends, for its supervisor. Every other code is a crash that a restart follows. */
export enum ExitCode {
  DONE = 0,
  CRASHED = 1,
  /** The settings can't work: a restart would fail the same way. */
  CONFIG = 78,
  /** The experiment ended. */
  ENDED = 80,
  /** Standard input has ended. */
  STOPPED = 81,
}

const AFTER_THE_END_MS = 1000; // to handle packets received before it
const AFTER_A_STOP_MS = 200; // the parent kills a stopped process soon after

/**
 * Run a component that `afspm run` has started, and end the process when `main` returns, the experiment ends, or
 * standard input does.
 *
 * @param main the component's work; the component is done when its promise is fulfilled.
 * @param longestStepS for how many seconds the event loop may be busy before the process counts as frozen.
 */
export function runComponent(main: (experiment: Experiment) => Promise<void>, longestStepS?: number): void {
  process.on("SIGINT", () => undefined); // Ctrl-C reaches the whole terminal; the supervisor decides what it ends
  let experiment: Experiment | undefined;
  const input = createInterface({ input: process.stdin });
  input.on("line", (line) => {
    if (experiment) {
      experiment.emit("line", line);
      return;
    }
    try {
      experiment = new Experiment(parseLaunch(line), longestStepS);
    } catch (error) {
      process.exit(exitCodeOf(error));
    }
    void run(experiment, main);
  });
  input.on("close", () => {
    if (experiment) experiment.stop(new StopRequested("standard input has ended"));
    else process.exit(ExitCode.STOPPED);
  });
}

async function run(experiment: Experiment, main: (experiment: Experiment) => Promise<void>): Promise<never> {
  const done = main(experiment).then(() => ExitCode.DONE, (error: unknown) => {
    return exitCodeOf(error);
  });
  const over = experiment.untilEnd().catch(async (reason: unknown) => {
    const graceMs = reason instanceof ExperimentEnded ? AFTER_THE_END_MS : AFTER_A_STOP_MS;
    await Promise.race([done, new Promise((resolve) => setTimeout(resolve, graceMs))]);
    return exitCodeOf(reason);
  });
  const code = await Promise.race([done, over]);
  await experiment.close();
  process.exit(code);
}

function exitCodeOf(error: unknown): ExitCode {
  if (error instanceof ExperimentEnded) return ExitCode.ENDED;
  if (error instanceof StopRequested) return ExitCode.STOPPED;
  process.stderr.write(`ERROR ${error instanceof ConfigError ? error.message : error instanceof Error ? error.stack : String(error)}\n`);
  return error instanceof ConfigError ? ExitCode.CONFIG : ExitCode.CRASHED;
}
