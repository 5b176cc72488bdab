/** Takes one scan or spectrum, exactly once, over interruptions and restarts. */

import { create, toBinary } from "@bufbuild/protobuf";
import { type Commands, encodeAction } from "./commands.js";
import type { Deadline } from "./conditions.js";
import type { ControlHold } from "./control.js";
import { Cycle } from "./cycle.js";
import { InvalidValue, MeasurementFailed, NoResponse, Refused } from "./errors.js";
import { ControlRequest, ControlResponse, ParameterMsgSchema } from "./generated/control_pb.js";
import { checkKey, KeyedResults } from "./keyed.js";
import type { Link, Listener } from "./link.js";
import { encodePlace, encodeScanParameters, type Scan, type ScanParameters, type Spectrum } from "./model.js";
import { ScanTarget, SpectrumTarget, type Target } from "./targets.js";

const BEGUN_WITHIN_S = 5; // from the success of the action to its published state
const MOST_FAILURES = 5; // in a row without a known reason, before a person has to look

/** A result, and the reasons of interruptions, for a person. */
export interface Measured<T> {
  readonly things: readonly T[];
  readonly interruptions: readonly string[];
}

/** A cycle that receives the scheduler's packets until it is closed. */
class Watch<T extends Scan | Spectrum> {
  private readonly listener: Listener;

  constructor(private readonly link: Link, target: Target<T>, readonly cycle: Cycle<T>) {
    this.listener = (published, ours) => {
      if (!ours) return;
      const result = target.of(published);
      if (result) cycle.onResult(result, target.fits(result), published.packet.timeNs);
      else if (published.name === "ScopeStateMsg") cycle.onState(published.value, published.packet.timeNs);
    };
    link.listeners.add(this.listener);
  }

  get isOver(): boolean {
    return this.cycle.outcome !== undefined;
  }

  close(): void {
    this.link.listeners.delete(this.listener);
  }
}

class Task<T extends Scan | Spectrum> {
  attempt = 0;
  failures = 0;
  interruptions: string[] = [];
  watch: Watch<T> | undefined;

  constructor(readonly target: Target<T>, readonly key: string | undefined, readonly stem: string, readonly deadline: Deadline) {}

  /** The id of the action that begins it: another in every attempt, the same in every life. */
  get id(): string {
    return `${this.stem}/${this.attempt}`;
  }

  dropWatch(): void {
    this.watch?.close();
    this.watch = undefined;
  }
}

/** Takes measurements over one link, one at a time. */
export class Measurements {
  private readonly results: KeyedResults;
  private readonly channels = new Map<string, ReadonlySet<string>>();
  private unfinished: Watch<Scan> | Watch<Spectrum> | undefined;
  private rounded: { readonly facts: string; readonly now: ScanParameters | undefined } | undefined;
  private busy = false;

  constructor(private readonly link: Link, private readonly control: ControlHold, private readonly commands: Commands) {
    this.results = new KeyedResults(link.launch.state_dir, link.launch.name);
    const intent = this.results.pending;
    if (intent) { // follow from the first packet on the measurement that an earlier life requested
      const [what, place, detail] = JSON.parse(intent.facts) as [string, never, never];
      const moves = link.launch.sample_coordinates;
      const since = BigInt(intent.sinceNs);
      if (what === "scan") this.unfinished = this.watch(new ScanTarget(place ?? undefined, detail ?? undefined, moves), since, true);
      else this.unfinished = this.watch(new SpectrumTarget(place ?? undefined, detail ?? undefined, moves), since, true);
    }
  }

  /** Measure until the result is complete; with a key, once in all lives of the component. */
  async take<T extends Scan | Spectrum>(target: Target<T>, key: string | undefined, deadline: Deadline): Promise<Measured<T>> {
    if (key !== undefined) {
      checkKey(key);
      const kept = this.results.find(key, target.facts);
      if (kept) return { things: kept.packets.map(target.decode), interruptions: kept.interruptions };
    }
    if (this.busy) throw new InvalidValue("a measurement is under way already: await it before the next");
    this.busy = true;
    const { name } = this.link.launch;
    const task = new Task(target, key, key === undefined ? this.link.requests.nextId() : `${name}/key/${key}`, deadline);
    try {
      await this.link.waitCaughtUp(deadline); // cached results must not count as new ones
      await this.takeUp(task);
      const things = await this.finish(task);
      this.channels.set(target.what, new Set(things.map(target.nameOf)));
      if (key !== undefined) this.results.fulfil(key, target.facts, { packets: things.map((thing) => thing.packet), interruptions: task.interruptions });
      return { things, interruptions: task.interruptions };
    } catch (error) {
      if (key !== undefined && task.watch && !task.watch.isOver) {
        this.unfinished = task.watch as unknown as Watch<Scan>; // its key leads to the result later
        task.watch = undefined;
      }
      throw error;
    } finally {
      task.dropWatch();
      this.busy = false;
    }
  }

  private watch<T extends Scan | Spectrum>(target: Target<T>, sinceNs: bigint, resumed = false): Watch<T> {
    return new Watch(this.link, target, new Cycle<T>(target.busy, sinceNs, resumed));
  }

  /** Continue this measurement if an earlier life or call had started it. */
  private async takeUp<T extends Scan | Spectrum>(task: Task<T>): Promise<void> {
    const intent = this.results.pending;
    const watch = this.unfinished as Watch<T> | undefined;
    if (task.key === undefined && watch) {
      if (watch.cycle.begun) await this.link.wait(() => watch.isOver, task.deadline); // later results belong to another measurement
      watch.close();
      if (!watch.isOver) this.unfinished = undefined;
      return;
    }
    this.unfinished = undefined;
    if (intent?.key !== task.key || intent?.facts !== task.target.facts) {
      watch?.close();
      return;
    }
    task.attempt = intent.attempt; // ids of earlier attempts are answered, not executed
    task.interruptions = [...intent.interruptions];
    task.watch = watch;
  }

  /** Return the newest result of each name: a restarted translator may have published one twice. */
  private async finish<T extends Scan | Spectrum>(task: Task<T>): Promise<T[]> {
    const { watch, target } = task;
    if (watch?.cycle.begun) await this.link.wait(() => watch.isOver, task.deadline);
    let cycle = watch?.cycle;
    if (cycle?.outcome === "completed") this.control.releaseInherited();
    else cycle = await this.control.hold(() => this.measure(task), 0, task.deadline);
    return [...new Map(cycle.results.map((thing) => [target.nameOf(thing), thing])).values()];
  }

  /** Repeat attempts until one is complete. */
  private async measure<T extends Scan | Spectrum>(task: Task<T>): Promise<Cycle<T>> {
    if (task.watch?.isOver && task.watch.cycle.outcome !== "completed") task.dropWatch();
    for (;;) {
      const { watch } = task;
      if (watch?.isOver && this.isDone(task, watch.cycle)) return watch.cycle;
      if (watch?.isOver) task.dropWatch();
      await this.attempt(task);
    }
  }

  /**
   * Prepare and start once, and follow to the end. A request left unanswered when control was lost, or sent in an earlier
   * life, is repeated with the same id, so that it is not executed twice.
   */
  private async attempt<T extends Scan | Spectrum>(task: Task<T>): Promise<void> {
    const { link, commands } = this;
    const { target, deadline } = task;
    await this.control.regain(deadline);
    if (task.watch?.isOver) return; // it had started, and ended during the wait for control
    const isNew = !task.watch;
    if (isNew) {
      task.attempt += 1;
      if (task.key !== undefined) {
        const { key, attempt, interruptions } = task;
        this.results.intend({ key, facts: target.facts, attempt, sinceNs: String(link.newestNs), interruptions });
      }
    }
    await this.prepare(target, deadline);
    const states = link.count("ScopeStateMsg");
    const watch = (task.watch ??= this.watch(target, link.newestNs));
    const response = await commands.send(ControlRequest.REQ_ACTION, encodeAction(target.start), task.id, deadline, () => watch.cycle.begun);
    if (response.code === ControlResponse.REP_SUCCESS || watch.cycle.begun) {
      await this.follow(task, watch);
      return;
    }
    const isLost = response.code === ControlResponse.REP_NOT_IN_CONTROL || response.code === ControlResponse.REP_WRONG_CONTROL_MODE;
    if (response.code === ControlResponse.REP_NO_RESPONSE || (!isNew && isLost)) watch.cycle.controlWasLost(); // it may have started
    else task.dropWatch();
    try {
      await commands.getOver(ControlRequest.REQ_ACTION, response, states, deadline);
    } catch (error) {
      if (isNew || !(error instanceof Refused)) throw error; // a request refused to an earlier life needs another id
    }
  }

  /** Follow a measurement from the success of its action to its end. */
  private async follow<T extends Scan | Spectrum>(task: Task<T>, watch: Watch<T>): Promise<void> {
    const isBegun = await this.link.waitConnected(() => watch.cycle.begun || watch.isOver, BEGUN_WITHIN_S, task.deadline);
    if (!isBegun) watch.cycle.outcome = "vanished";
    else if (!(await this.link.wait(() => watch.isOver, task.deadline))) throw new NoResponse(`the ${task.target.what}`, "it was not finished in time, and goes on");
  }

  /** Whether the result is complete; otherwise note the reason for the next attempt. */
  private isDone<T extends Scan | Spectrum>(task: Task<T>, cycle: Cycle<T>): boolean {
    const { target } = task;
    const names = new Set(cycle.results.map(target.nameOf));
    const missing = [...(this.channels.get(target.what) ?? [])].filter((name) => !names.has(name));
    if (cycle.outcome === "completed" && !missing.length) return true;
    if (cycle.outcome === "completed") this.channels.delete(target.what); // missing again: these channels are no longer recorded
    const why = cycle.outcome === "completed" ? `without ${missing.join(", ")}, which it had before` : this.whyFailed(cycle);
    task.interruptions.push(why);
    this.link.log("WARNING", `${target.what} interrupted: ${why}; retrying`);
    task.failures = this.control.held ? task.failures + 1 : 0; // a loss of control is a known reason
    if (task.failures >= MOST_FAILURES) throw new MeasurementFailed(`the ${target.what} failed ${task.failures} times: ${why}`);
    return false;
  }

  private whyFailed(cycle: Cycle<unknown>): string {
    if (!this.control.held) return `control was lost: ${this.control.whyLost}`;
    if (cycle.outcome === "interrupted") return "something else stopped it";
    if (cycle.outcome === "another") return "not what was asked for was measured; what else sets the microscope?";
    return "the microscope is free again without a result; was it restarted?";
  }

  /** Set the parameters of a target that differ from those in force. */
  private async prepare(target: Target<Scan | Spectrum> | Target<Scan> | Target<Spectrum>, deadline: Deadline): Promise<void> {
    const { link, commands } = this;
    if (target instanceof SpectrumTarget) {
      if (target.kind !== undefined) {
        const kind = toBinary(ParameterMsgSchema, create(ParameterMsgSchema, { parameter: "x-spec-kind", value: target.kind }));
        await commands.ask(ControlRequest.REQ_PARAM, kind, deadline);
      }
      const now = link.probePositionM;
      const isThere = now && target.atM && now[0] === target.atM[0] && now[1] === target.atM[1];
      if (target.atM && !isThere) await commands.set(ControlRequest.REQ_SET_PROBE_POS, encodePlace(target.atM), "ProbePosition", deadline);
    } else if (target instanceof ScanTarget && (target.region || target.shape)) {
      const now = link.scanParameters;
      const isRounded = this.rounded?.facts === target.facts && JSON.stringify(this.rounded.now) === JSON.stringify(now);
      // in sample coordinates the tip position of a region changes with time
      if (!(target.moves && target.region) && (target.isSet(now) || isRounded)) return;
      await commands.set(ControlRequest.REQ_SET_SCAN_PARAMS, encodeScanParameters(target.region, target.shape), "ScanParameters2d", deadline);
      // a controller may round: this is the requested value after rounding
      this.rounded = target.isSet(link.scanParameters, true) ? { facts: target.facts, now: link.scanParameters } : undefined;
    }
  }
}

