import assert from "node:assert/strict";
import { test } from "node:test";
import { Conditions, deadlineIn } from "../src/conditions.js";
import { Cycle } from "../src/cycle.js";
import { ScopeState } from "../src/wire.js";

const { SS_SCANNING, SS_FREE, SS_INTERRUPTED } = ScopeState;

test("results between SCANNING and FREE are those of the scan", () => {
  const cycle = new Cycle<string>(SS_SCANNING, 10n);
  cycle.onState(SS_SCANNING, 11n);
  cycle.onResult("height", true, 12n);
  cycle.onState(SS_FREE, 13n);
  assert.equal(cycle.outcome, "completed");
  assert.deepEqual(cycle.results, ["height"]);
});

test("what was published before it was asked for does not count", () => {
  const cycle = new Cycle<string>(SS_SCANNING, 10n);
  cycle.onState(SS_SCANNING, 9n);
  cycle.onResult("height", true, 10n);
  cycle.onState(SS_FREE, 10n);
  assert.equal(cycle.begun, false);
});

test("a stop, a restart and another's scan are told apart", () => {
  const outcomes = [[SS_INTERRUPTED, undefined], [SS_FREE, undefined], [SS_FREE, false]] as const;
  const found = outcomes.map(([last, fits]) => {
    const cycle = new Cycle<string>(SS_SCANNING, -1n);
    cycle.onState(SS_SCANNING, 1n);
    if (fits !== undefined) cycle.onResult("other", fits, 2n);
    cycle.onState(last, 3n);
    return cycle.outcome;
  });
  assert.deepEqual(found, ["interrupted", "vanished", "another"]);
});

test("waiting ends with the condition, the time or the experiment", async () => {
  const conditions = new Conditions();
  let isThere = false;
  const waiting = conditions.wait(() => isThere);
  isThere = true;
  conditions.notify();
  assert.equal(await waiting, true);
  assert.equal(await conditions.wait(() => false, deadlineIn(0.01)), false);
  const failing = conditions.wait(() => false);
  conditions.fail(new Error("over"));
  await assert.rejects(failing, /over/);
  await assert.rejects(conditions.wait(() => true), /over/);
});
