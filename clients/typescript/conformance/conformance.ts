/** The conformance program of this client: `afspm test-client -- node dist/conformance/conformance.js`. */

import { createRegistry, type DescFile, fromBinary, fromJson, type JsonValue, toBinary, toJson } from "@bufbuild/protobuf";
import { decode, type Experiment, messageOf, type Packet, RequestError, responseName, runComponent, type Scan, type Shape, type Spectrum, wire, type XY } from "../src/index.js";

interface Step {
  id: number; do: string; message: string; bytes: string; fields: JsonValue; prefix: string; timeout_s: number; number: number;
  object?: string; problem: number; name: string; value: string; unit: string | null; set: boolean; mode: keyof typeof wire.ControlMode;
  center_m: XY; size_m: XY; angle_deg: number; shape: Shape; position_m: XY; kind: string;
}
type Answer = Record<string, unknown>;

const DEGREE = Math.PI / 180;
const REGISTRY = createRegistry(...Object.values(wire).filter((found): found is DescFile => (found as { kind?: unknown }).kind === "file"));

runComponent(async (experiment) => {
  const packets: Packet[] = [];
  experiment.on("packet", (packet) => packets.push(packet));
  experiment.on("line", (line) => {
    const step = JSON.parse(line) as Step;
    void answer(experiment, packets, step).then((found) => process.stdout.write(`${textOf({ id: step.id, ...found })}\n`));
  });
  await experiment.untilEnd();
});

/** Return JSON with numbers that JSON.stringify can't write: nanoseconds, and minus zero. */
function textOf(found: Answer): string {
  const text = JSON.stringify(found, (_, value: unknown) => (typeof value === "bigint" ? `number:${value}` : Object.is(value, -0) ? "number:-0.0" : value));
  return text.replace(/"number:([-\d.]+)"/g, "$1");
}

async function answer(experiment: Experiment, packets: Packet[], step: Step): Promise<Answer> {
  try {
    return { ok: true, ...(await carryOut(experiment, packets, step)) };
  } catch (error) {
    if (error instanceof RequestError) return { ok: false, response: nameOf(error.code), reason: error.reason, detail: error.detail };
    return { ok: false, error: String(error) };
  }
}

async function carryOut(experiment: Experiment, packets: Packet[], step: Step): Promise<Answer> {
  const timeout = { timeoutS: step.timeout_s };
  switch (step.do) {
    case "ready": await experiment.ready(); return {};
    case "decode": {
      const schema = schemaOf(step.message);
      const message = fromBinary(schema, Buffer.from(step.bytes, "base64"));
      return { fields: toJson(schema, message), bytes: base64(toBinary(schema, message)) };
    }
    case "encode": return { bytes: base64(toBinary(schemaOf(step.message), fromJson(schemaOf(step.message), step.fields))) };
    case "wait": {
      const find = () => packets.findIndex(({ envelope }) => envelope.startsWith(step.prefix));
      if (!(await experiment.waitUntil(() => find() >= 0, timeout))) throw new Error(`no ${step.prefix} came in time`);
      return factsOf(packets.splice(find(), 1)[0]!);
    }
    case "request": return request(experiment, step.number, step.object === undefined ? undefined : Buffer.from(step.object, "base64"));
    case "request_control": await experiment.requestControl({ ...timeout, ...(step.problem && { solving: step.problem }) }); return {};
    case "release_control": await experiment.releaseControl(); return {};
    case "get_parameter": return parameter(experiment, { name: step.name, value: null, unit: null });
    case "set_parameter": return parameter(experiment, step);
    case "action": return request(experiment, wire.ControlRequest.REQ_ACTION, toBinary(wire.ActionMsgSchema, fromJson(wire.ActionMsgSchema, { action: step.name })));
    case "problem": await (step.set ? experiment.flag(step.number) : experiment.clear(step.number)); return {};
    case "mode": await experiment.setMode(wire.ControlMode[step.mode]); return {};
    case "scan": {
      const region = { centerM: step.center_m, sizeM: step.size_m, angleRad: step.angle_deg * DEGREE };
      const { scans, interruptions } = await experiment.scan(region, { shape: step.shape, ...timeout });
      return { scans: scans.map(scanFacts), interruptions: interruptions.length };
    }
    case "spectrum": {
      const { spectrum, interruptions } = await experiment.spectrum(step.position_m, { kind: step.kind, ...timeout });
      return { spectra: [spectrumFacts(spectrum)], interruptions: interruptions.length };
    }
    case "state": {
      const { mode, holder, problems } = experiment.controlState;
      return { in_control: experiment.inControl, holder: holder || null, mode: wire.ControlMode[mode], problems, scope_state: wire.ScopeState[experiment.state] };
    }
    case "end": await experiment.end(); return {};
    default: throw new Error(`no step ${step.do}`);
  }
}

async function request(experiment: Experiment, number: number, object?: Uint8Array): Promise<Answer> {
  const { code, reason, detail, payload } = await experiment.request(number, object);
  return { ok: code === 0, response: nameOf(code), reason, detail, ...(payload.length && { object: base64(payload) }) };
}

async function parameter(experiment: Experiment, { name, value, unit }: { name: string; value: string | null; unit: string | null }): Promise<Answer> {
  const message = fromJson(wire.ParameterMsgSchema, { parameter: name, value, units: unit });
  const answered = await request(experiment, wire.ControlRequest.REQ_PARAM, toBinary(wire.ParameterMsgSchema, message));
  if (!answered["ok"]) return answered;
  const inForce = fromBinary(wire.ParameterMsgSchema, Buffer.from(String(answered["object"] ?? ""), "base64"));
  return { value: inForce.value, unit: inForce.units ?? null };
}

function factsOf(packet: Packet): Answer {
  const published = decode(packet);
  if (published.name === "Scan2d") return scanFacts(published.value);
  if (published.name === "Spec1d") return spectrumFacts(published.value);
  if (published.name === "ScanLines") return scanFacts({ ...published.value, packet, region: published.value.parameters.region! });
  return packetFacts(packet);
}

function packetFacts({ envelope, timeNs }: Packet): Answer {
  return { envelope, message: messageOf(envelope), timestamp_ns: timeNs ?? null };
}

function scanFacts({ channel, unit, region, shape, values, packet }: Pick<Scan, "channel" | "unit" | "region" | "shape" | "values" | "packet">): Answer {
  return { ...packetFacts(packet), channel, unit, center_m: region.centerM, size_m: region.sizeM, angle_deg: (region.angleRad ?? 0) / DEGREE, shape, values: valueFacts(values), view: values.buffer === packet.payload.buffer };
}

function spectrumFacts({ kind, names, units, positionM, values, packet }: Spectrum): Answer {
  const shape = [values.length / Math.max(1, names.length), names.length];
  return { ...packetFacts(packet), kind, names, units, position_m: positionM ?? null, shape, values: valueFacts(values), view: values.buffer === packet.payload.buffer };
}

function valueFacts(values: Float64Array): Answer {
  let [sum, moment] = [0, 0];
  values.forEach((value, index) => { sum += value; moment += index * value; });
  return { count: values.length, first: values[0] ?? null, last: values.at(-1) ?? null, sum, moment };
}

function schemaOf(name: string) {
  const schema = REGISTRY.getMessage(`afspm.${name}`);
  if (!schema) throw new Error(`no message ${name}`);
  return schema;
}

function nameOf(code: number): string | number {
  return code in wire.ControlResponse ? responseName(code) : code;
}

function base64(bytes: Uint8Array): string {
  return Buffer.from(bytes).toString("base64");
}
