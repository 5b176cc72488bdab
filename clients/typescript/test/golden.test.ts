import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { createRegistry, fromBinary, fromJson, type JsonValue, toBinary, toJson } from "@bufbuild/protobuf";
import { decodePacket, decodeResponse, encodePacket, encodeRequest, encodeResponse } from "../src/frames.js";
import { decode } from "../src/link.js";
import { Scan } from "../src/model.js";
import * as wire from "../src/wire.js";

interface Golden {
  messages: { name: string; type: string; fields: JsonValue; hex: string }[];
  requests: { name: string; request: keyof typeof wire.ControlRequest; frames: string[] }[];
  responses: { name: string; response: number; frames: string[] }[];
  our_responses: { name: string; response: number; frames: string[] }[];
  published: { type: string; envelope: string; frames: string[] }[];
}

const golden = JSON.parse(readFileSync(new URL("../../../../proto/golden.json", import.meta.url), "utf8")) as Golden;
const registry = createRegistry(
  wire.file_analysis, wire.file_channels, wire.file_control, wire.file_drift, wire.file_feedback, wire.file_geometry,
  wire.file_grants, wire.file_instruments, wire.file_journal, wire.file_lines, wire.file_panel, wire.file_scan,
  wire.file_spectroscopy,
);
const bytes = (hex: string) => Buffer.from(hex, "hex");
const hex = (frames: Uint8Array[]) => frames.map((frame) => Buffer.from(frame).toString("hex"));

for (const { name, type, fields, hex: reference } of golden.messages) {
  test(`message: ${name}`, () => {
    const schema = registry.getMessage(`afspm.${type}`);
    assert.ok(schema, type);
    const message = fromJson(schema, fields);
    assert.equal(Buffer.from(toBinary(schema, message)).toString("hex"), reference);
    assert.deepEqual(toJson(schema, fromBinary(schema, bytes(reference))), toJson(schema, message));
  });
}

for (const { name, request, frames } of golden.requests) {
  test(`request: ${name}`, () => {
    const [, object = ""] = frames;
    assert.deepEqual(hex(encodeRequest(wire.ControlRequest[request], bytes(object), "")), frames);
    assert.deepEqual(hex(encodeRequest(wire.ControlRequest[request], bytes(object), "a/1")), [frames[0], object, "612f31"]);
  });
}

for (const { name, response, frames } of [...golden.responses, ...golden.our_responses]) {
  test(`response: ${name}`, () => {
    const decoded = decodeResponse(frames.map(bytes));
    assert.equal(decoded.code, response);
    assert.deepEqual(hex(encodeResponse(decoded)), frames);
    const padded = Array.from({ length: 7 }, (_, index) => bytes(frames[index] ?? ""));
    assert.deepEqual(hex(encodeResponse(decodeResponse(padded))), frames);
  });
}

for (const { type, envelope, frames } of golden.published) {
  test(`packet: ${envelope}`, () => {
    const packet = decodePacket(frames.map(bytes));
    assert.equal(packet.envelope, envelope);
    assert.deepEqual(hex(encodePacket(packet)), frames);
    const { name } = decode(packet);
    assert.ok(name === type || name === "", `${type} was taken for ${name}`);
  });
}

test("a scan has its values in their order, and its region in metres and radians", () => {
  const { hex: reference } = golden.messages.find(({ name }) => name === "scan 3x2")!;
  const scan = Scan.decode({ envelope: "Scan2d", payload: bytes(reference), timeNs: undefined });
  assert.deepEqual([...scan.values], [0, 1.5, -2.25, 1e-9, 3e300, -0]);
  assert.deepEqual(scan.shape, [2, 3]);
  assert.equal(scan.at(1, 0), 1e-9);
  assert.ok(Math.abs(scan.region.sizeM[0] - 2e-6) < 1e-18 && Math.abs(scan.region.centerM[0] - 749.5e-9) < 1e-18);
  assert.ok(Math.abs(scan.region.angleRad! - (12.5 * Math.PI) / 180) < 1e-15);
  assert.equal(scan.channel, "Height Retrace");
});
