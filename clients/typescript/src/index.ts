export { ExitCode, runComponent } from "./component.js";
export { type ExperimentEvents, Experiment, type Feedback, type MeasuredSpectrum, type ScanSet, type Timeout, type Value } from "./experiment.js";
export * from "./errors.js";
export { decodePacket, decodeResponse, encodePacket, encodeRequest, type Packet, type Response } from "./frames.js";
export { type Keys, type Launch, launchOfGuest, parseLaunch } from "./launch.js";
export { decode, messageOf, type Published } from "./link.js";
export { type ControlState, type Region, Scan, ScanLines, type ScanParameters, type Shape, Spectrum, type XY } from "./model.js";
export { convert } from "./units.js";
export * as wire from "./wire.js";
