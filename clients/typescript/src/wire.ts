/** The messages of `proto/`, as protoc-gen-es makes them. */
export * from "./generated/analysis_pb.js";
export * from "./generated/channels_pb.js";
export * from "./generated/control_pb.js";
export * from "./generated/drift_pb.js";
export * from "./generated/feedback_pb.js";
export * from "./generated/geometry_pb.js";
export * from "./generated/grants_pb.js";
export * from "./generated/instruments_pb.js";
export * from "./generated/journal_pb.js";
export * from "./generated/lines_pb.js";
export * from "./generated/panel_pb.js";
export * from "./generated/scan_pb.js";
export * from "./generated/spectroscopy_pb.js";
