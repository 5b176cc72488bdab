/** Packets, requests and responses as the frames that travel. */

import { create, fromBinary, toBinary } from "@bufbuild/protobuf";
import { TimestampSchema } from "@bufbuild/protobuf/wkt";
import { type ResponseDetail, WireError } from "./errors.js";

export const KILL = "KILL";
const NS_PER_S = 1_000_000_000n;
const LONGEST_ID = 200;

/** What was published: the bytes of a message under its envelope. */
export interface Packet {
  readonly envelope: string;
  readonly payload: Uint8Array;
  /** When it was first published, ns since the Unix epoch; undefined where the publisher does not say. */
  readonly timeNs: bigint | undefined;
}

/** The answer to a request. */
export interface Response {
  /** The number of a `ControlResponse`. */
  readonly code: number;
  /** An object in bytes, such as the `ParameterMsg` in force; mostly empty. */
  readonly payload: Uint8Array;
  /** The reason of a failure, for a person. */
  readonly reason: string;
  /** The id of the request that it answers; empty if that had none. */
  readonly id: string;
  readonly detail: ResponseDetail;
}

export function encodeRequest(kind: number, object: Uint8Array, id: string): Uint8Array[] {
  const idBytes = Buffer.from(id);
  if (idBytes.length > LONGEST_ID) throw new WireError(`a request id of ${idBytes.length} bytes: at most ${LONGEST_ID}`);
  if (id) return [Uint8Array.of(kind), object, idBytes];
  return object.length ? [Uint8Array.of(kind), object] : [Uint8Array.of(kind)];
}

export function encodeResponse(response: Response): Uint8Array[] {
  const detail = response.detail ? Uint8Array.of(response.detail) : new Uint8Array();
  const frames = [Uint8Array.of(response.code), response.payload, Buffer.from(response.reason), Buffer.from(response.id), detail];
  while (frames.length > 1 && !frames.at(-1)?.length) frames.pop();
  return frames;
}

/** Decode one to five frames; frames appended by a newer peer are ignored. */
export function decodeResponse(frames: readonly Uint8Array[]): Response {
  const [code, payload, reason, id, detail] = frames;
  if (code?.length !== 1) throw new WireError(`a response of ${frames.length} frames, the first of ${code?.length ?? 0} bytes`);
  return { code: code[0]!, payload: payload ?? new Uint8Array(), reason: text(reason), id: text(id), detail: detail?.[0] ?? 0 };
}

export function encodePacket(packet: Packet): Uint8Array[] {
  const frames = [Buffer.from(packet.envelope), packet.payload];
  return packet.timeNs === undefined ? frames : [...frames, encodeTime(packet.timeNs)];
}

/** Decode two or three frames; the message is left as bytes. */
export function decodePacket(frames: readonly Uint8Array[]): Packet {
  const [envelope, payload, time] = frames;
  if (!envelope || !payload || frames.length > 3) throw new WireError(`a packet of ${frames.length} frames instead of two or three`);
  return { envelope: text(envelope), payload, timeNs: time?.length ? decodeTime(time) : undefined };
}

/** Return the bytes of a `google.protobuf.Timestamp`. */
export function encodeTime(timeNs: bigint): Uint8Array {
  return toBinary(TimestampSchema, create(TimestampSchema, { seconds: timeNs / NS_PER_S, nanos: Number(timeNs % NS_PER_S) }));
}

/** Return ns since the Unix epoch. */
export function decodeTime(bytes: Uint8Array): bigint {
  const time = fromBinary(TimestampSchema, bytes);
  return time.seconds * NS_PER_S + BigInt(time.nanos);
}

function text(frame: Uint8Array | undefined): string {
  return frame ? Buffer.from(frame.buffer, frame.byteOffset, frame.length).toString("utf8") : "";
}
