/** A requested scan or spectrum, and the test whether a published result matches it. Pure. */

import type { Packet } from "./frames.js";
import { ScopeState } from "./generated/control_pb.js";
import type { Published } from "./link.js";
import { type Region, Scan, type ScanParameters, type Shape, Spectrum, type XY } from "./model.js";

const SAME = 1e-6; // of the size: finer than any controller positions
const FITS = 1e-2; // of the size: a controller's rounding, not another region
const SPOT_M = 20e-9; // a scanner with sensors reports the measured position, some nanometres from the requested one
const MOVED = 0.5; // of the size: with drift correction a scan is published at its registered position
const SHEARED = 0.1; // of the size: and with its registered size and angle

/** A requested measurement; undefined: as set. */
export interface Target<T extends Scan | Spectrum> {
  readonly what: string;
  readonly start: string;
  readonly busy: ScopeState;
  /** The parts by which a later life of the component recognises it. */
  readonly facts: string;
  /** Return the result in a packet; undefined: there is none. */
  of(published: Published): T | undefined;
  fits(result: T): boolean;
  /** Return the name of a part of a result: the channel of a scan. */
  nameOf(result: T): string;
  decode(packet: Packet): T;
}

export class ScanTarget implements Target<Scan> {
  readonly what = "scan";
  readonly start = "start-scan";
  readonly busy = ScopeState.SS_SCANNING;
  readonly facts: string;

  /** @param moves positions are in sample coordinates, and a scan is published at its registered position. */
  constructor(readonly region: Region | undefined, readonly shape: Shape | undefined, readonly moves: boolean) {
    this.facts = JSON.stringify([this.what, region ?? null, shape ?? null]);
  }

  of = (published: Published) => (published.name === "Scan2d" ? published.value : undefined);
  nameOf = (scan: Scan) => scan.channel;
  decode = (packet: Packet) => Scan.decode(packet);

  fits(scan: Scan): boolean {
    if (this.shape && !isSameShape(this.shape, scan.shape)) return false;
    if (!this.region) return true;
    if (!this.moves) return isNear(this.region, scan.region, FITS);
    const isClose = distance(this.region.centerM, scan.region.centerM) <= MOVED * Math.min(...this.region.sizeM);
    return isClose && isNear({ ...this.region, centerM: scan.region.centerM }, scan.region, SHEARED);
  }

  /** Whether the parameters in force match the wanted ones, up to a controller's rounding (`isRounded`). */
  isSet(now: ScanParameters | undefined, isRounded = false): boolean {
    if (!now || (this.shape && !(now.shape && isSameShape(this.shape, now.shape)))) return false;
    return !this.region || (now.region !== undefined && isNear(this.region, now.region, isRounded ? FITS : SAME));
  }
}

export class SpectrumTarget implements Target<Spectrum> {
  readonly what = "spectrum";
  readonly start = "start-spec";
  readonly busy = ScopeState.SS_SPEC;
  readonly facts: string;

  constructor(readonly atM: XY | undefined, readonly kind: string | undefined, readonly moves: boolean) {
    this.facts = JSON.stringify([this.what, atM ?? null, kind ?? null]);
  }

  of = (published: Published) => (published.name === "Spec1d" ? published.value : undefined);
  nameOf = () => ""; // a result has one spectrum, and the next may be of another kind
  decode = (packet: Packet) => Spectrum.decode(packet);

  fits(spectrum: Spectrum): boolean {
    if (this.kind !== undefined && spectrum.kind !== this.kind) return false;
    return !this.atM || !spectrum.positionM || this.moves || distance(this.atM, spectrum.positionM) <= SPOT_M;
  }
}

function isSameShape(a: Shape, b: Shape): boolean {
  return a[0] === b[0] && a[1] === b[1];
}

/** Whether all corners of two regions differ by less than `tolerance` of their size. */
function isNear(a: Region, b: Region, tolerance: number): boolean {
  const sizeM = Math.hypot(...a.sizeM);
  const turn = (a.angleRad ?? 0) - (b.angleRad ?? 0);
  const turned = turn - 2 * Math.PI * Math.round(turn / (2 * Math.PI));
  return distance(a.centerM, b.centerM) <= tolerance * sizeM && distance(a.sizeM, b.sizeM) <= tolerance * sizeM && Math.abs(turned) <= tolerance;
}

function distance(a: XY, b: XY): number {
  return Math.hypot(a[0] - b[0], a[1] - b[1]);
}
