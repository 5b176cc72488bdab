/** Keyed measurements happen once: the intent is on disk before the request, the result after it. */

import { closeSync, fsyncSync, mkdirSync, openSync, readFileSync, renameSync, rmSync, writeSync } from "node:fs";
import { dirname, join } from "node:path";
import { createHash } from "node:crypto";
import { InvalidValue } from "./errors.js";
import type { Packet } from "./frames.js";

/** A measurement that was requested and is not finished. */
export interface Intent {
  readonly key: string;
  readonly facts: string;
  readonly attempt: number;
  /** Packets up to this time belong to earlier measurements. */
  readonly sinceNs: string;
  readonly interruptions: readonly string[];
}

/** A stored measurement: its packets, and the reasons of interruptions. */
export interface Kept {
  readonly packets: readonly Packet[];
  readonly interruptions: readonly string[];
}

interface Head {
  readonly key: string;
  readonly facts: string;
  readonly interruptions: readonly string[];
  readonly packets: readonly { readonly envelope: string; readonly timeNs?: string; readonly size: number }[];
}

export class KeyedResults {
  private readonly folder: string | undefined;
  private intent: Intent | undefined;

  /** @param stateDir of the run; empty: no measurement survives a restart. */
  constructor(stateDir: string, name: string) {
    this.folder = stateDir ? join(stateDir, `${name}.keyed`) : undefined;
    const text = this.folder && readOrNothing(join(this.folder, "pending.json"));
    this.intent = text ? (JSON.parse(text.toString()) as Intent) : undefined;
  }

  /** The intent that was written down and not fulfilled. */
  get pending(): Intent | undefined {
    return this.intent;
  }

  intend(intent: Intent): void {
    this.intent = intent;
    if (this.folder) write(join(this.folder, "pending.json"), [Buffer.from(JSON.stringify(intent))]);
  }

  /** Return the result of an earlier life or call. Throws InvalidValue: the key was used for another measurement. */
  find(key: string, facts: string): Kept | undefined {
    const bytes = this.folder && readOrNothing(this.path(key));
    if (!bytes) return undefined;
    const end = bytes.indexOf("\n");
    const head = JSON.parse(bytes.toString("utf8", 0, end)) as Head;
    if (head.key !== key || head.facts !== facts) throw new InvalidValue(`the key ${key} was used for another measurement: ${head.facts}`);
    let at = end + 1;
    const packets = head.packets.map(({ envelope, timeNs, size }) => {
      return { envelope, timeNs: timeNs === undefined ? undefined : BigInt(timeNs), payload: bytes.subarray(at, (at += size)) };
    });
    return { interruptions: head.interruptions, packets };
  }

  fulfil(key: string, facts: string, { packets, interruptions }: Kept): void {
    if (!this.folder) return;
    const heads = packets.map(({ envelope, timeNs, payload }) => ({ envelope, ...(timeNs !== undefined && { timeNs: String(timeNs) }), size: payload.length }));
    const head: Head = { key, facts, interruptions, packets: heads };
    write(this.path(key), [Buffer.from(`${JSON.stringify(head)}\n`), ...packets.map(({ payload }) => payload)]);
    this.intent = undefined;
    rmSync(join(this.folder, "pending.json"), { force: true });
  }

  private path(key: string): string {
    return join(this.folder!, `${createHash("sha256").update(key).digest("hex").slice(0, 24)}.result`);
  }
}

/** Throws InvalidValue: the key can't be part of a request's id. */
export function checkKey(key: string): void {
  if (!/^[\x20-\x2e\x30-\x7e\u00a0-\uffff]+$/.test(key) || Buffer.byteLength(key) > 100) {
    throw new InvalidValue(`${JSON.stringify(key)} can't be a key: 1 to 100 printable characters without '/'`);
  }
}

function readOrNothing(path: string): Buffer | undefined {
  try {
    return readFileSync(path);
  } catch (error) {
    if ((error as NodeJS.ErrnoException).code === "ENOENT") return undefined;
    throw error;
  }
}

/** Write a file atomically, and flush it to the disk. */
function write(path: string, parts: readonly Uint8Array[]): void {
  mkdirSync(dirname(path), { recursive: true });
  const file = openSync(`${path}.new`, "w");
  try {
    for (const part of parts) for (let at = 0; at < part.length; ) at += writeSync(file, part, at);
    fsyncSync(file);
  } finally {
    closeSync(file);
  }
  renameSync(`${path}.new`, path);
}
