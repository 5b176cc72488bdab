/** Measurements and states, in SI units. The only module that knows units and corners of the wire format. */

import { create, fromBinary, toBinary } from "@bufbuild/protobuf";
import { InvalidValue, WireError } from "./errors.js";
import type { Packet } from "./frames.js";
import { ControlMode, ControlStateSchema, ScopeState } from "./generated/control_pb.js";
import { ScanLinesSchema } from "./generated/lines_pb.js";
import {
  Scan2dSchema, ScanParameters2dSchema, type ScanParameters2d, type SpatialAspects,
} from "./generated/scan_pb.js";
import { ProbePositionSchema, Spec1dSchema, SpecDataSchema, type ProbePosition } from "./generated/spectroscopy_pb.js";
import { convert } from "./units.js";
import { doubles, split } from "./values.js";
import type { Timestamp } from "@bufbuild/protobuf/wkt";

const SCAN_VALUES = 4;
const SPECTRUM_DATA = 4;
const SPECTRUM_VALUES = 5;

/** A place: x grows to the right, y upwards; in metres. */
export type XY = readonly [x: number, y: number];
/** Pixels as [rows, columns]. */
export type Shape = readonly [rows: number, columns: number];

/** A rectangle turned about its centre. */
export interface Region {
  readonly centerM: XY;
  /** Width and height in metres, before the rotation. */
  readonly sizeM: XY;
  /** Counter-clockwise, in radians; 0 by default. */
  readonly angleRad?: number;
}

/** Region and number of pixels of the next scan. */
export interface ScanParameters {
  readonly region: Region | undefined;
  readonly shape: Shape | undefined;
}

/** One channel of a scan. */
export class Scan {
  private constructor(
    /** Region of the scan. */
    readonly region: Region,
    /** Rows and columns. */
    readonly shape: Shape,
    /** Such as "Height Retrace". */
    readonly channel: string,
    /** Of the values. */
    readonly unit: string,
    /** Row after row, x and y ascending: pixel (row, column) is `values[row * shape[1] + column]`. */
    readonly values: Float64Array,
    /** When it was finished, ns since the Unix epoch. */
    readonly timeNs: bigint | undefined,
    /** The controller's own file; empty if there is none. */
    readonly filename: string,
    /** As it came. */
    readonly packet: Packet,
  ) {}

  /** Decode a `Scan2d`. Throws WireError, InvalidValue. */
  static decode(packet: Packet): Scan {
    const { rest, chunks } = split(packet.payload, SCAN_VALUES);
    const scan = fromBinary(Scan2dSchema, rest);
    const { region, shape } = parametersOf(scan.params ?? create(ScanParameters2dSchema));
    const values = doubles(chunks);
    if (!region) throw new WireError("a scan without a region");
    const pixels = shape ?? [0, 0];
    if (values.length && values.length !== pixels[0] * pixels[1]) {
      throw new WireError(`a scan of ${pixels[0]} x ${pixels[1]} pixels with ${values.length} values`);
    }
    return new Scan(region, pixels, scan.channel ?? "", scan.params?.data?.units ?? "", values, timeOf(scan.timestamp), scan.filename ?? "", packet);
  }

  /** Return the value of a pixel. */
  at(row: number, column: number): number {
    const value = this.values[row * this.shape[1] + column];
    if (value === undefined || column >= this.shape[1]) throw new InvalidValue(`no pixel (${row}, ${column})`);
    return value;
  }

  /** Return where a pixel lies, in metres; fractions lie between pixels. */
  placeM(row: number, column: number): XY {
    const { centerM, sizeM, angleRad = 0 } = this.region;
    const u = sizeM[0] * (column / Math.max(1, this.shape[1] - 1) - 0.5);
    const v = sizeM[1] * (row / Math.max(1, this.shape[0] - 1) - 0.5);
    const [cos, sin] = [Math.cos(angleRad), Math.sin(angleRad)];
    return [centerM[0] + cos * u - sin * v, centerM[1] + sin * u + cos * v];
  }
}

/** Neighbouring rows of one channel of a running scan. */
export class ScanLines {
  private constructor(
    /** Of the whole scan, as requested. */
    readonly parameters: ScanParameters,
    /** Rows that came, and columns. */
    readonly shape: Shape,
    readonly channel: string,
    readonly unit: string,
    readonly values: Float64Array,
    /** The index in the whole scan of the first row in `values`. */
    readonly firstRow: number,
    /** When the scan began, ns since the Unix epoch: the same for all its lines. */
    readonly timeNs: bigint | undefined,
  ) {}

  /** Decode a `ScanLines`. Throws WireError, InvalidValue. */
  static decode(message: Uint8Array): ScanLines {
    const { rest, chunks } = split(message, SCAN_VALUES);
    const lines = fromBinary(ScanLinesSchema, rest);
    const parameters = parametersOf(lines.params ?? create(ScanParameters2dSchema));
    const values = doubles(chunks);
    const columns = parameters.shape?.[1] ?? values.length;
    if (values.length % Math.max(1, columns)) throw new WireError(`lines of ${columns} pixels with ${values.length} values`);
    const shape: Shape = [values.length / Math.max(1, columns), columns];
    return new ScanLines(parameters, shape, lines.channel ?? "", lines.params?.data?.units ?? "", values, lines.firstRow ?? 0, timeOf(lines.timestamp));
  }
}

/** Several variables measured together, point by point. */
export class Spectrum {
  private constructor(
    /** Of the probe, in metres; undefined if unknown. */
    readonly positionM: XY | undefined,
    /** Such as "IV" or "force". */
    readonly kind: string,
    readonly names: readonly string[],
    readonly units: readonly string[],
    /** All variables of the first point, then of the second. */
    readonly values: Float64Array,
    readonly timeNs: bigint | undefined,
    readonly filename: string,
    /** As it came. */
    readonly packet: Packet,
  ) {}

  /** Decode a `Spec1d`. Throws WireError, InvalidValue. */
  static decode(packet: Packet): Spectrum {
    const outer = split(packet.payload, SPECTRUM_DATA);
    const spectrum = fromBinary(Spec1dSchema, outer.rest);
    const inner = split(outer.chunks.at(-1) ?? new Uint8Array(), SPECTRUM_VALUES);
    const data = fromBinary(SpecDataSchema, inner.rest);
    const values = doubles(inner.chunks);
    if (data.names.length !== data.units.length || values.length % Math.max(1, data.names.length)) {
      throw new WireError(`a spectrum of ${data.names.length} names, ${data.units.length} units and ${values.length} values`);
    }
    return new Spectrum(placeOf(spectrum.position), spectrum.type ?? "", data.names, data.units, values, timeOf(spectrum.timestamp), spectrum.filename ?? "", packet);
  }

  /** Return one variable by its name, a value for each point. */
  variable(name: string): Float64Array {
    const index = this.names.indexOf(name);
    if (index < 0) throw new InvalidValue(`no variable ${name}; there are ${this.names.join(", ")}`);
    const width = this.names.length;
    return Float64Array.from({ length: this.values.length / width }, (_, point) => this.values[point * width + index]!);
  }
}

/** Mode, holder of control and problems. */
export interface ControlState {
  readonly mode: ControlMode;
  /** The component in control; empty: none. */
  readonly holder: string;
  /** The numbers of the problems that are flagged. */
  readonly problems: readonly number[];
}

export function decodeControlState(message: Uint8Array): ControlState {
  const state = fromBinary(ControlStateSchema, message);
  return { mode: state.controlMode ?? ControlMode.CM_UNDEFINED, holder: state.clientInControlId ?? "", problems: state.problemsSet };
}

export function decodeScanParameters(message: Uint8Array): ScanParameters {
  return parametersOf(fromBinary(ScanParameters2dSchema, message));
}

/** Return the bytes of a `ScanParameters2d`: region, shape or both. Throws InvalidValue. */
export function encodeScanParameters(region: Region | undefined, shape: Shape | undefined): Uint8Array {
  const message = create(ScanParameters2dSchema);
  if (region) message.spatial = spatialOf(region);
  if (shape) {
    if (!shape.every((pixels) => Number.isInteger(pixels) && pixels > 0)) throw new InvalidValue(`${shape} is no shape: [rows, columns]`);
    message.data = { $typeName: "afspm.DataAspects", shape: { $typeName: "afspm.Size2u", y: shape[0], x: shape[1] } };
  }
  return toBinary(ScanParameters2dSchema, message);
}

export function decodePlace(message: Uint8Array): XY | undefined {
  return placeOf(fromBinary(ProbePositionSchema, message));
}

export function encodePlace([x, y]: XY): Uint8Array {
  if (!Number.isFinite(x) || !Number.isFinite(y)) throw new InvalidValue(`(${x}, ${y}) is no place`);
  return toBinary(ProbePositionSchema, create(ProbePositionSchema, { point: { x, y }, units: "m" }));
}

function spatialOf({ centerM: [x, y], sizeM: [width, height], angleRad = 0 }: Region): SpatialAspects {
  if (![x, y, width, height, angleRad].every(Number.isFinite)) throw new InvalidValue("a region needs finite numbers");
  if (!(width > 0 && height > 0)) throw new InvalidValue(`a region of ${width} m x ${height} m is empty`);
  return {
    $typeName: "afspm.SpatialAspects",
    roi: {
      $typeName: "afspm.RotRect2d",
      topLeft: { $typeName: "afspm.Point2d", x: x - width / 2, y: y - height / 2 },
      size: { $typeName: "afspm.Size2d", x: width, y: height },
      angle: convert(angleRad, "rad", "deg"),
    },
    lengthUnits: "m",
    angularUnits: "deg",
  };
}

function parametersOf(message: ScanParameters2d): ScanParameters {
  const shape = message.data?.shape;
  const pixels: Shape | undefined = shape?.x === undefined || shape.y === undefined ? undefined : [shape.y, shape.x];
  return { region: regionOf(message.spatial), shape: pixels };
}

function regionOf(spatial: SpatialAspects | undefined): Region | undefined {
  const { topLeft, size, angle = 0 } = spatial?.roi ?? {};
  if (topLeft?.x === undefined || topLeft.y === undefined || size?.x === undefined || size.y === undefined) return undefined;
  const metres = (value: number) => convert(value, spatial?.lengthUnits || "m", "m");
  const sizeM: XY = [metres(size.x), metres(size.y)];
  const centerM: XY = [metres(topLeft.x) + sizeM[0] / 2, metres(topLeft.y) + sizeM[1] / 2];
  return { centerM, sizeM, angleRad: convert(angle, spatial?.angularUnits || "deg", "rad") };
}

function placeOf(position: ProbePosition | undefined): XY | undefined {
  const { x, y } = position?.point ?? {};
  if (x === undefined || y === undefined) return undefined;
  return [convert(x, position?.units || "m", "m"), convert(y, position?.units || "m", "m")];
}

function timeOf(time: Timestamp | undefined): bigint | undefined {
  return time && time.seconds * 1_000_000_000n + BigInt(time.nanos);
}

export { ControlMode, ScopeState };
