// The generated messages and services of the protocol, palpate.v1.

export * from "./gen/palpate/v1/exercise_pb.js";
export * from "./gen/palpate/v1/geometry_pb.js";
export * from "./gen/palpate/v1/haptic_pb.js";
export * from "./gen/palpate/v1/scene_pb.js";
export * from "./gen/palpate/v1/session_pb.js";
export * from "./gen/palpate/v1/view_pb.js";
