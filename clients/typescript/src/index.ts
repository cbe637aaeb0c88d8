// See and touch tissue from a browser. `Server` provides the calls of the protocol (palpate/v1); `fetchMesh` and
// `Frames` provide the surface, `watchSamples` what the tools feel, and a `Tool` touches.

export { Field, type Rectangle } from "./field.js";
export { Frames, type FrameTold } from "./frames.js";
export { fetchMesh, meshOf, type MeshData } from "./geometry.js";
export { type Lead } from "./poses.js";
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
  Server,
  sleep,
} from "./server.js";
export { type Action, Tool, type Wanted } from "./tool.js";
export { norm, vec, type Vec3 } from "./vector.js";
