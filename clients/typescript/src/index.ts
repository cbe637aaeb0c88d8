// See and touch tissue from a browser. `Server` provides the calls of the protocol (palpate/v1); `fetchMesh` and
// `Frames` provide the surface, `followWound` what blades have cut, `followBurns` what tips have burnt, `watchSamples` what the tools feel, a `Tool` touches, and an `InstrumentTool` leads an
// `Instrument`.

export { Burns, followBurns } from "./burns.js";
export { Field, type Rectangle } from "./field.js";
export { Frames, type FrameTold } from "./frames.js";
export { fetchMesh, meshOf, type MeshData } from "./geometry.js";
export {
  grasper,
  Instrument,
  type InstrumentPose,
  type InstrumentTip,
  knife,
  MAX_TIPS,
  type Row,
  type TipForces,
  type Wrench,
} from "./instrument.js";
export { type InstrumentFelt, InstrumentTool } from "./instrument-tool.js";
export { type Lead, type Tip } from "./poses.js";
export { watchSamples } from "./samples.js";
export {
  backoffMs,
  describe,
  elsewhere,
  type Failure,
  isGone,
  isPassing,
  isUnimplemented,
  isUnreached,
  keepOpen,
  CALL_TIMEOUT_MS,
  reasonOf,
  fieldOf,
  Server,
  sleep,
} from "./server.js";
export { type Action, Tool, type Wanted } from "./tool.js";
export { cross, dot, norm, plus, rotated, type Rotation, rotationTo, unit, vec, type Vec3 } from "./vector.js";
export { type Cut, followWound, type Lip, mixed, Wound, type WoundChange } from "./wound.js";
