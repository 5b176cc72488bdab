import { create, fromBinary, toBinary } from "@bufbuild/protobuf";
import { TimestampSchema, type Timestamp } from "@bufbuild/protobuf/wkt";
import { EventEmitter } from "node:events";
import { Commands, encodeAction } from "./commands.js";
import { deadlineIn } from "./conditions.js";
import { ControlHold } from "./control.js";
import { ConfigError, InvalidValue, NoResponse, Refused } from "./errors.js";
import { encodePacket, type Packet, type Response } from "./frames.js";
import { ControlMode, ControlRequest, ControlResponse, ParameterMsgSchema, type ScopeState } from "./generated/control_pb.js";
import { ZCtrlParametersSchema, type ZCtrlParameters } from "./generated/feedback_pb.js";
import { NoteSchema, ProgressSchema, ToldSchema } from "./generated/journal_pb.js";
import { Heartbeat } from "./heartbeat.js";
import { type Launch, launchOfGuest } from "./launch.js";
import { Link, type Published } from "./link.js";
import { Measurements } from "./measurement.js";
import { type ControlState, encodePlace, type Region, type Scan, type ScanLines, type ScanParameters, type Shape, type Spectrum, type XY } from "./model.js";
import { ProblemNames } from "./problems.js";
import { Publisher } from "./publisher.js";
import { ScanTarget, SpectrumTarget } from "./targets.js";
import { convert, PARAMETER_UNITS } from "./units.js";

const CLOCK_REQUEST = 101;
const RELAY_REQUEST = 102;
const JOINED_WITHIN_S = 5;
const LONGEST_STEP_S = 30;

/** The value of a parameter: a number in a unit, or a word. */
export type Value = number | string | boolean;

/** How long a call may take in real seconds; by default it waits for ever. */
export interface Timeout {
  readonly timeoutS?: number;
}

/** All channels of a scan. */
export interface ScanSet {
  readonly scans: readonly Scan[];
  /** The reasons of interruptions before this measurement was complete. */
  readonly interruptions: readonly string[];
}

/** A spectrum, and the reasons of earlier interruptions. */
export interface MeasuredSpectrum {
  readonly spectrum: Spectrum;
  readonly interruptions: readonly string[];
}

/** The feedback of the tip's height. */
export interface Feedback {
  readonly on?: boolean;
  /** In the controller's own units. */
  readonly proportionalGain?: number;
  readonly integralGain?: number;
  /** In the unit of the operating mode: A for a tunnelling current, V, m, Hz or N in force microscopy. */
  readonly setpoint?: number;
}

export interface ExperimentEvents {
  scan: [scan: Scan, packet: Packet];
  spectrum: [spectrum: Spectrum, packet: Packet];
  /** Rows of a scan that is still running. */
  lines: [lines: ScanLines, packet: Packet];
  state: [state: ScopeState];
  control: [state: ControlState];
  /** Whatever this component listens to, its bytes not decoded. */
  packet: [packet: Packet];
  /** A further line of standard input. */
  line: [line: string];
}

/**
 * A running experiment, from the side of one component.
 *
 * Lengths are in metres, angles in radians, times in seconds; other units of parameters are named. Commands
 * request control by themselves and release it; while it is refused or revoked, they wait for it. Every
 * call may throw `Refused`, `NoResponse`, `ControlLost`, `ExperimentEnded` and `StopRequested`.
 */
export class Experiment extends EventEmitter<ExperimentEvents> {
  readonly problems: ProblemNames;
  private readonly link: Link;
  private readonly hold: ControlHold;
  private readonly commands: Commands;
  private readonly measurements: Measurements;
  private readonly heartbeat: Heartbeat | undefined;
  private readonly publisher: Publisher | undefined;

  /**
   * @param launch the part that this component has; see `runComponent` and `Experiment.join`.
   * @param longestStepS for how many seconds the event loop may be busy before the process counts as frozen.
   */
  constructor(readonly launch: Launch, longestStepS = LONGEST_STEP_S) {
    super();
    const { sockets } = launch;
    this.problems = new ProblemNames(launch.problems);
    if (sockets.heartbeat) this.heartbeat = new Heartbeat(launch, sockets.heartbeat, longestStepS);
    if (sockets.publish) this.publisher = new Publisher(sockets.publish, launch.keys);
    this.link = new Link(launch);
    this.hold = new ControlHold(this.link);
    this.commands = new Commands(this.link, this.hold);
    this.measurements = new Measurements(this.link, this.hold, this.commands);
    this.link.listeners.add((published) => this.tell(published));
  }

  /**
   * Join a running experiment.
   *
   * @param where the folder of a run, or of all runs: then the newest one.
   * @param name the name shown as the holder of control. Two that join need different names.
   */
  static async join(where: string, name: string): Promise<Experiment> {
    const experiment = new Experiment(await launchOfGuest(where, name));
    try {
      await experiment.ready({ timeoutS: JOINED_WITHIN_S });
    } catch (error) {
      await experiment.close();
      throw error;
    }
    return experiment;
  }

  /** Wait until the scheduler is connected and all packets of its cache have arrived. */
  async ready({ timeoutS }: Timeout = {}): Promise<void> {
    const deadline = deadlineIn(timeoutS);
    if (this.launch.sockets.control && !(await this.link.wait(() => this.link.requests.connected, deadline))) {
      throw new NoResponse("joining", "the scheduler does not answer; is the experiment running?");
    }
    await this.link.waitCaughtUp(deadline);
  }

  // --- looking ---

  /** The activity of the microscope. */
  get state(): ScopeState { return this.link.state; }
  /** Mode, holder of control and problems. */
  get controlState(): ControlState { return this.link.controlState ?? { mode: ControlMode.CM_UNDEFINED, holder: "", problems: [] }; }
  /** Whether this component is in control. */
  get inControl(): boolean { return this.hold.held; }
  /** Region and shape of the next scan; undefined before the first packet. */
  get scanParameters(): ScanParameters | undefined { return this.link.scanParameters; }
  get feedback(): ZCtrlParameters | undefined { return this.link.feedback; }
  get probePositionM(): XY | undefined { return this.link.probePositionM; }

  /** Wait until a condition holds, tested after each published packet; return false at the timeout. */
  waitUntil(condition: () => boolean, { timeoutS }: Timeout = {}): Promise<boolean> {
    return this.link.wait(condition, deadlineIn(timeoutS));
  }

  /** Wait for the end of the experiment; the promise is rejected with `ExperimentEnded`, or `StopRequested`. */
  untilEnd(): Promise<never> {
    return this.link.wait(() => false) as Promise<never>;
  }

  // --- measuring ---

  /**
   * Take a scan. A scan interrupted by a problem, MANUAL or a restart is repeated once control is granted again.
   *
   * @param region undefined: as set.
   * @param options.shape [rows, columns]; undefined: as set.
   * @param options.key makes it happen once in this run: a component that is killed and started again gets the scan of
   * its earlier life. Each measurement has a key of its own.
   */
  async scan(region?: Region, options: Timeout & { readonly shape?: Shape; readonly key?: string } = {}): Promise<ScanSet> {
    const target = new ScanTarget(region, options.shape, this.launch.sample_coordinates);
    const { things, interruptions } = await this.measurements.take(target, options.key, deadlineIn(options.timeoutS));
    return { scans: things, interruptions };
  }

  /**
   * Take a spectrum.
   *
   * @param atM position in metres; undefined: the present one.
   * @param options.kind such as "IV"; undefined: as set.
   */
  async spectrum(atM?: XY, options: Timeout & { readonly kind?: string; readonly key?: string } = {}): Promise<MeasuredSpectrum> {
    const target = new SpectrumTarget(atM, options.kind, this.launch.sample_coordinates);
    const { things, interruptions } = await this.measurements.take(target, options.key, deadlineIn(options.timeoutS));
    return { spectrum: things[0]!, interruptions };
  }

  // --- setting and getting ---

  /** Set a parameter to a number in `unit` (SI without one) or a word; return the value in force, in the same unit. */
  async set(parameter: string, value: Value, unit?: string, timeout: Timeout = {}): Promise<Value> {
    if (typeof value === "number" && !Number.isFinite(value)) throw new InvalidValue(`${parameter} can't be set to ${value}`);
    const units = unit ?? (typeof value === "number" ? PARAMETER_UNITS.get(parameter) : undefined);
    const message = create(ParameterMsgSchema, { parameter, value: String(value), ...(units !== undefined && { units }) });
    const response = await this.command(ControlRequest.REQ_PARAM, toBinary(ParameterMsgSchema, message), timeout);
    return response.payload.length ? valueIn(response.payload, unit) : value;
  }

  /** Return the value of a parameter in `unit`; without one in SI, or in the microscope's unit for other than base parameters. */
  async get(parameter: string, unit?: string): Promise<Value> {
    const message = toBinary(ParameterMsgSchema, create(ParameterMsgSchema, { parameter }));
    const id = this.link.requests.nextId();
    const response = await this.commands.send(ControlRequest.REQ_PARAM, message, id, deadlineIn(undefined));
    return valueIn(accepted(`parameter ${parameter}`, response).payload, unit);
  }

  /** Set the given parts of the feedback. */
  async setFeedback({ on, proportionalGain, integralGain, setpoint }: Feedback, timeout: Timeout = {}): Promise<void> {
    const message = create(ZCtrlParametersSchema, {
      ...(on !== undefined && { feedbackOn: on }), ...(proportionalGain !== undefined && { proportionalGain }),
      ...(integralGain !== undefined && { integralGain }), ...(setpoint !== undefined && { setPoint: setpoint }),
    });
    await this.command(ControlRequest.REQ_SET_ZCTRL_PARAMS, toBinary(ZCtrlParametersSchema, message), timeout);
  }

  /** Move the probe to (x, y) in metres; return on arrival. */
  async moveProbe(xyM: XY, { timeoutS }: Timeout = {}): Promise<void> {
    const deadline = deadlineIn(timeoutS);
    await this.hold.hold(() => this.commands.set(ControlRequest.REQ_SET_PROBE_POS, encodePlace(xyM), "ProbePosition", deadline), 0, deadline);
  }

  /** Perform an action of the microscope, such as "x-pulse". */
  async action(name: string, timeout: Timeout = {}): Promise<void> {
    await this.command(ControlRequest.REQ_ACTION, encodeAction(name), timeout);
  }

  /** Whether the microscope has an action. */
  async supports(action: string): Promise<boolean> {
    const response = await this.commands.send(ControlRequest.REQ_ACTION_SUPPORT, encodeAction(action), this.link.requests.nextId(), deadlineIn(undefined));
    return response.code === ControlResponse.REP_SUCCESS;
  }

  // --- control and the experiment ---

  /**
   * Hold control while `body` runs: no other component acts between two calls in it. After a loss of control the next call
   * waits for it.
   *
   * @param options.solving the problem to put right, by name or number: control is only given while that is flagged.
   */
  control<T>(body: () => Promise<T>, options: Timeout & { readonly solving?: string | number } = {}): Promise<T> {
    const problem = options.solving === undefined ? 0 : this.problems.number(options.solving);
    return this.hold.hold(body, problem, deadlineIn(options.timeoutS));
  }

  /** Flag a problem, by name or number: control is taken from its holder, until the problem is cleared. */
  async flag(problem: string | number): Promise<void> {
    await this.order(ControlRequest.REQ_ADD_EXP_PRBLM, this.problems.number(problem));
  }

  /** Clear a problem; no error if it is not flagged. */
  async clear(problem: string | number): Promise<void> {
    await this.order(ControlRequest.REQ_RMV_EXP_PRBLM, this.problems.number(problem));
  }

  isFlagged(problem: string | number): boolean {
    return this.controlState.problems.includes(this.problems.number(problem));
  }

  /** Set MANUAL (no component has control) or AUTOMATED. */
  async setMode(mode: ControlMode): Promise<void> {
    await this.order(ControlRequest.REQ_SET_CONTROL_MODE, mode);
  }

  /** End the experiment for everybody, this process included. */
  async end(): Promise<void> {
    accepted("ending the experiment", await this.link.requests.request(ControlRequest.REQ_END_EXPERIMENT));
  }

  /** Return the experiment time, ns since the Unix epoch, and its speed. */
  async time(): Promise<{ readonly nowNs: bigint; readonly speed: number }> {
    const { payload } = accepted("the time", await this.link.requests.request(CLOCK_REQUEST));
    const text = Buffer.from(payload).toString();
    const { speed = 1 } = JSON.parse(text) as { speed?: number };
    return { nowNs: BigInt(/"now_ns": *(\d+)/.exec(text)?.[1] ?? "0"), speed }; // JSON.parse would round it
  }

  /** Wait for a number of seconds of experiment time. */
  async sleep(seconds: number): Promise<void> {
    const start = (await this.time()).nowNs;
    for (;;) {
      const { nowNs, speed } = await this.time();
      const left = seconds - Number(nowNs - start) / 1e9;
      if (left <= 0) return;
      await this.link.wait(() => false, deadlineIn(left / speed));
    }
  }

  /** Write a remark of 1 to 1000 characters into the record of the run, on a scan or on now. */
  async note(text: string, scan?: Scan): Promise<void> {
    const now = (await this.time()).nowNs;
    const about = scan?.timeNs;
    const note = create(NoteSchema, { timestamp: timestamp(about ?? now), who: this.launch.name, text, written: timestamp(now), ...(about !== undefined && { scan: timestamp(about) }) });
    await this.relay("Note", toBinary(NoteSchema, note));
  }

  /** Publish the progress of this component, for people. */
  async progress(done: number, of: number): Promise<void> {
    const now = (await this.time()).nowNs;
    const progress = create(ProgressSchema, { timestamp: timestamp(now), name: this.launch.name, done: BigInt(done), of: BigInt(of) });
    await this.relay("Progress", toBinary(ProgressSchema, progress));
  }

  /** Publish a message defined by this component. The envelope is the message's name, or begins with it and an underscore. */
  async publish(envelope: string, message: Uint8Array): Promise<void> {
    if (!this.publisher) throw new ConfigError(`${this.launch.name} was given no address to publish on: say what it \`publishes\``);
    await this.publisher.publish((timeNs) => encodePacket({ envelope, payload: message, timeNs }), (await this.time()).nowNs);
  }

  /** Send a request for which there is no method, repeated with its id until it is answered. */
  request(kind: number, object: Uint8Array = new Uint8Array(), { timeoutS }: Timeout = {}): Promise<Response> {
    return this.link.requests.request(kind, object, this.link.requests.nextId(), deadlineIn(timeoutS));
  }

  /** Ask for control and keep it until `releaseControl`; `control` gives it back by itself. */
  async requestControl(options: Timeout & { readonly solving?: string | number } = {}): Promise<void> {
    const problem = options.solving === undefined ? 0 : this.problems.number(options.solving);
    await this.hold.keep(problem, deadlineIn(options.timeoutS));
  }

  async releaseControl(): Promise<void> {
    await this.hold.giveUp();
  }

  log(level: "DEBUG" | "INFO" | "WARNING" | "ERROR", text: string): void {
    this.link.log(level, text);
  }

  /** Leave the experiment for a reason, with which all waiting calls are rejected. */
  stop(reason: Error): void {
    this.link.conditions.fail(reason);
  }

  /** Leave the experiment, and release control. */
  async close(): Promise<void> {
    if (this.launch.sockets.control) await this.hold.release();
    await Promise.all([this.heartbeat?.close(), this.link.close(), this.publisher?.close()]);
  }

  private command(kind: number, object: Uint8Array, { timeoutS }: Timeout): Promise<Response> {
    const deadline = deadlineIn(timeoutS);
    return this.hold.hold(() => this.commands.ask(kind, object, deadline), 0, deadline);
  }

  /** Ask the scheduler itself, which needs no control. */
  private async order(kind: ControlRequest, number: number): Promise<void> {
    accepted(ControlRequest[kind], await this.link.requests.request(kind, Uint8Array.of(number)));
  }

  private async relay(message: string, payload: Uint8Array): Promise<void> {
    const told = toBinary(ToldSchema, create(ToldSchema, { message, payload }));
    accepted(message, await this.link.requests.request(RELAY_REQUEST, told));
  }

  private tell(published: Published): void {
    const { packet } = published;
    if (!this.link.isListenedTo(packet.envelope)) return;
    if (published.name === "Scan2d") this.emit("scan", published.value, packet);
    else if (published.name === "Spec1d") this.emit("spectrum", published.value, packet);
    else if (published.name === "ScanLines") this.emit("lines", published.value, packet);
    else if (published.name === "ScopeStateMsg") this.emit("state", published.value);
    else if (published.name === "ControlState") this.emit("control", published.value);
    this.emit("packet", packet);
  }
}

function accepted(what: string, response: Response): Response {
  if (response.code !== ControlResponse.REP_SUCCESS) throw new Refused(what, response.code, response.reason, response.detail);
  return response;
}

function valueIn(payload: Uint8Array, unit: string | undefined): Value {
  const { parameter = "", value = "", units } = fromBinary(ParameterMsgSchema, payload);
  const text = value.trim();
  if (/^(true|false)$/i.test(text)) return text.toLowerCase() === "true";
  const number = text === "" ? Number.NaN : Number(text);
  if (Number.isNaN(number)) return text;
  const wanted = unit ?? PARAMETER_UNITS.get(parameter);
  return units && wanted ? convert(number, units, wanted) : number;
}

function timestamp(timeNs: bigint): Timestamp {
  return create(TimestampSchema, { seconds: timeNs / 1_000_000_000n, nanos: Number(timeNs % 1_000_000_000n) });
}
