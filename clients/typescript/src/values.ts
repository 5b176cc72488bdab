/**
 * Takes the numbers of a message out of its bytes: a packed `repeated double` is tag, length, then little-endian
 * float64 values, which become a Float64Array without a copy; only the small rest is parsed.
 */

import { WireError } from "./errors.js";

const FIXED64 = 1;
const LENGTH_DELIMITED = 2;

/** The bytes of one field, and the message without it. */
export interface Split {
  readonly rest: Uint8Array;
  readonly chunks: readonly Uint8Array[];
}

/** Split a serialised message into its top-level field number `field` and the rest. */
export function split(message: Uint8Array, field: number): Split {
  const rest: Uint8Array[] = [];
  const chunks: Uint8Array[] = [];
  let at = 0;
  let keptFrom = 0;
  while (at < message.length) {
    const start = at;
    const tag = varint(message, at);
    const kind = tag.value & 7;
    at = tag.next;
    let length = kind === FIXED64 ? 8 : kind === 5 ? 4 : 0;
    if (kind === LENGTH_DELIMITED) ({ value: length, next: at } = varint(message, at));
    else if (kind === 0) length = varint(message, at).next - at;
    else if (!length) throw new WireError(`byte ${start} begins a field of the unknown kind ${kind}`);
    if (at + length > message.length) throw new WireError(`the message breaks off in the field at byte ${start}`);
    if (Math.floor(tag.value / 8) === field && (kind === LENGTH_DELIMITED || kind === FIXED64)) {
      chunks.push(message.subarray(at, at + length));
      rest.push(message.subarray(keptFrom, start));
      keptFrom = at + length;
    }
    at += length;
  }
  return { rest: chunks.length ? Buffer.concat([...rest, message.subarray(keptFrom)]) : message, chunks };
}

/** Return the values as an array: a view where they came in one piece that is aligned to 8 bytes, else one copy. */
export function doubles(chunks: readonly Uint8Array[]): Float64Array {
  const bytes = chunks.length === 1 ? chunks[0]! : Buffer.concat(chunks);
  if (bytes.length % 8) throw new WireError(`values of ${bytes.length} bytes are no float64 numbers`);
  const aligned = bytes.byteOffset % 8 ? Uint8Array.prototype.slice.call(bytes) : bytes;
  return new Float64Array(aligned.buffer, aligned.byteOffset, aligned.length / 8);
}

/** Return values as the field number `field` of a message: its tag and length, and a view of the values. */
export function packed(values: Float64Array, field: number): Uint8Array[] {
  if (!values.length) return [];
  return [Buffer.from([(field << 3) | LENGTH_DELIMITED, ...asVarint(values.byteLength)]), new Uint8Array(values.buffer, values.byteOffset, values.byteLength)];
}

/** Return a message as the field number `field` of another. */
export function nested(message: Uint8Array, field: number): Uint8Array {
  return Buffer.concat([Buffer.from([(field << 3) | LENGTH_DELIMITED, ...asVarint(message.length)]), message]);
}

function asVarint(value: number): number[] {
  const bytes = [];
  for (; value > 0x7f; value = Math.floor(value / 128)) bytes.push((value % 128) | 0x80);
  return [...bytes, value];
}

function varint(bytes: Uint8Array, at: number): { value: number; next: number } {
  let value = 0;
  for (let scale = 1; at < bytes.length && scale < 2 ** 64; scale *= 128) {
    const byte = bytes[at++]!;
    value += (byte & 0x7f) * scale;
    if (byte < 0x80) return { value, next: at };
  }
  throw new WireError("the message breaks off in a number");
}
