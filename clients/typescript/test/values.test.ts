import assert from "node:assert/strict";
import { test } from "node:test";
import { WireError } from "../src/errors.js";
import { convert } from "../src/units.js";
import { doubles, packed, split } from "../src/values.js";

function message(values: Float64Array): Buffer {
  return Buffer.concat([Buffer.from([0x08, 0x05]), ...packed(values, 4), Buffer.from([0x2a, 0x01, 0x41])]);
}

test("values that are aligned are a view of the message, and others are copied once", () => {
  const values = Float64Array.from({ length: 1000 }, (_, index) => index / 3);
  const bytes = message(values);
  const start = bytes.indexOf(Buffer.from(values.buffer));
  for (const shift of [0, 1, 5]) {
    const memory = new Uint8Array(new ArrayBuffer(bytes.length + 16));
    const at = ((8 - (start % 8)) % 8) + shift;
    memory.set(bytes, at);
    const { rest, chunks } = split(memory.subarray(at, at + bytes.length), 4);
    const found = doubles(chunks);
    assert.deepEqual(found, values);
    assert.equal(found.buffer === memory.buffer, shift === 0);
    assert.deepEqual([...rest], [0x08, 0x05, 0x2a, 0x01, 0x41]);
  }
});

test("values in two pieces are joined", () => {
  const bytes = Buffer.concat([message(Float64Array.of(1, 2)), message(Float64Array.of(3))]);
  assert.deepEqual([...doubles(split(bytes, 4).chunks)], [1, 2, 3]);
});

test("a message that breaks off is refused", () => {
  const bytes = message(Float64Array.of(1, 2, 3));
  for (const length of [1, 3, 4, 12, bytes.length - 1]) assert.throws(() => split(bytes.subarray(0, length), 4), WireError);
  assert.throws(() => doubles([bytes.subarray(0, 7)]), WireError);
});

test("units are converted exactly, and refused where they differ in kind", () => {
  assert.equal(convert(2, "um/s", "m/s"), 2e-6);
  assert.equal(convert(400, "nm", "m"), 4e-7);
  assert.equal(convert(3, "Å", "m"), 3e-10);
  assert.equal(convert(90, "deg", "rad"), Math.PI / 2);
  assert.equal(convert(1.5, "kHz", "Hz"), 1500);
  assert.throws(() => convert(1, "V", "m"), /can't be converted/);
  assert.throws(() => convert(1, "furlong", "m"), /not known/);
});
