/** The launch line: one line of JSON that describes a program's part in an experiment. */

import { createHmac } from "node:crypto";
import { readFile, readlink } from "node:fs/promises";
import { basename, join } from "node:path";
import { ConfigError } from "./errors.js";

/** The CURVE key pair of this process, and the owner of the key at each address; keys as Z85 text. */
export interface Keys {
  readonly name: string;
  readonly public: string;
  readonly secret: string;
  /** The names of their owners, by public key. */
  readonly peers: Readonly<Record<string, string>>;
  /** The names of their binders, by address. */
  readonly servers: Readonly<Record<string, string>>;
  /** Whether every socket is encrypted. */
  readonly everywhere: boolean;
}

/** A program's part in an experiment. */
export interface Launch {
  readonly name: string;
  readonly settings: Readonly<Record<string, unknown>>;
  readonly sockets: {
    readonly publish?: string | null;
    readonly subscribe: readonly string[];
    readonly control?: string | null;
    readonly heartbeat?: string | null;
  };
  /** Prefixes of the envelopes subscribed to; null: all of version 1. */
  readonly envelopes: readonly string[] | null;
  /** Problems that the experiment file names, with their numbers. */
  readonly problems: Readonly<Record<string, number>>;
  readonly run_dir: string;
  /** The folder for data that survive a restart; empty: none survive. */
  readonly state_dir: string;
  /** Seconds between heartbeats. */
  readonly beat_period_s: number;
  readonly beat_token: string;
  readonly request_timeout_s: number;
  readonly request_retries: number;
  readonly keys: Keys | null;
  /** The identity of the run; empty: unknown. */
  readonly run: string;
  readonly simulated: boolean;
  readonly sample_coordinates: boolean;
}

const DEFAULTS = {
  settings: {}, envelopes: null, problems: {}, run_dir: "", state_dir: "", beat_period_s: 1, beat_token: "",
  request_timeout_s: 5, request_retries: 3, keys: null, run: "", simulated: false, sample_coordinates: false,
} as const;

/** Read a launch line. Throws ConfigError. */
export function parseLaunch(line: string): Launch {
  let read: Partial<Launch> | null;
  try {
    read = JSON.parse(line) as Partial<Launch> | null;
  } catch (error) {
    throw new ConfigError(`the launch line is not JSON: ${String(error)} (this program is started by \`afspm run\`)`);
  }
  if (!read?.name || !read.sockets) throw new ConfigError("the launch line has no name or no sockets");
  // without encryption there is no pair: null, or {"insecure": "true"}
  const keys = read.keys?.secret ? read.keys : null;
  return { ...DEFAULTS, ...read, keys, name: read.name, sockets: { ...read.sockets, subscribe: read.sockets.subscribe ?? [] } };
}

/**
 * Return the launch line of a guest that joins a running experiment.
 *
 * @param where the folder of a run, or of all runs: then the newest one.
 * @param name the name shown as the holder of control.
 */
export async function launchOfGuest(where: string, name: string): Promise<Launch> {
  const folder = await runIn(where);
  const { guest } = JSON.parse(await readFile(join(folder, "run.json"), "utf8")) as { guest?: Partial<Launch> | null };
  if (!guest) throw new ConfigError(`${folder}: this part of the experiment can't be joined; join where its components run`);
  const keys = await readFile(join(folder, "state", "guest.keys"), "utf8").then((text) => JSON.parse(text) as Keys, () => guest.keys);
  return parseLaunch(JSON.stringify({ ...guest, name, keys, state_dir: join(folder, "state") }));
}

async function runIn(where: string): Promise<string> {
  const isRun = await readFile(join(where, "run.json")).then(() => true, () => false);
  if (isRun) return where;
  const link = await readlink(join(where, "latest")).catch(() => undefined);
  const newest = link ?? (await readFile(join(where, "latest.txt"), "utf8").catch(() => ""));
  if (!newest) throw new ConfigError(`${where}: there is no run here`);
  return join(where, basename(newest.trim()));
}

/** Return the identity of a component's request socket: the same in every life, and secret if there are keys. */
export function routingId(name: string, keys: Keys | null): string {
  return keys?.secret ? `${name}\0${createHmac("sha256", keys.secret).update(name).digest("hex").slice(0, 16)}` : name;
}

/** Return the socket options for a connection to `address`; none for a plain connection. Throws ConfigError. */
export function curveOptions(keys: Keys | null, address: string): { curvePublicKey?: string; curveSecretKey?: string; curveServerKey?: string } {
  if (!keys?.secret) return {};
  const owner = keys.servers[address];
  if (owner === undefined && !keys.everywhere) return {};
  const key = Object.entries(keys.peers).find(([, name]) => name === owner)?.[0];
  if (key === undefined) throw new ConfigError(`it is not known whose key to expect at ${address}: ${owner ?? "it has no owner"}`);
  return { curvePublicKey: keys.public, curveSecretKey: keys.secret, curveServerKey: key };
}
