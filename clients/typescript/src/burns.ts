// What tips have burnt of a surface, as `GetBurns` returns it: how burnt each vertex is.

import type { GetBurnsResponse, VertexBurn } from "./gen/palpate/v1/view_pb.js";
import { CALL_TIMEOUT_MS, type Server } from "./server.js";

/** A part of an answer, as far as it is used. */
type Part = Pick<GetBurnsResponse, "version" | "continues"> & { burns: readonly Pick<VertexBurn, "vertex" | "burn">[] };

export class Burns {
  /** The version of what is burnt; 0 before anything was. */
  version = 0;
  /** Of each vertex, time of contact divided by that in which it burns through: 0 to 1. */
  readonly burn: Float32Array<ArrayBuffer>;

  /** Of a mesh with so many vertices. */
  constructor(readonly vertexCount: number) {
    this.burn = new Float32Array(vertexCount);
  }

  /** Takes all parts of an answer that asked for what is new since `version`. Throws if they don't fit, and changes nothing then. */
  take(parts: readonly Part[]): void {
    const [first] = parts;
    if (!first) throw new RangeError("the server tells of no burns");
    const burns = parts.flatMap((part) => part.burns);
    // Also refuses what is no number.
    const isBurn = ({ vertex, burn }: Pick<VertexBurn, "vertex" | "burn">) => vertex < this.vertexCount && burn >= 0 && burn <= 1;
    if (!burns.every(isBurn)) throw new RangeError("burns of another surface");
    if (!first.continues || this.version === 0) this.burn.fill(0);
    for (const { vertex, burn } of burns) this.burn[vertex] = burn;
    this.version = first.version;
  }
}

/** Requests what is new of the burns at a refinement, and takes it. `burns` is of that refinement's mesh. */
export async function followBurns(server: Server, sessionId: string, refinement: number, burns: Burns, signal?: AbortSignal): Promise<void> {
  const parts: GetBurnsResponse[] = [];
  let numbers = 0;
  const request = { sessionId, refinement, sinceVersion: burns.version };
  for await (const part of server.views.getBurns(request, { signal, timeoutMs: CALL_TIMEOUT_MS })) {
    // Each part counts, so that empty ones end as well.
    numbers += 1 + part.burns.length;
    if (numbers > 2 * burns.vertexCount + 1) throw new RangeError("the server's burns have no end");
    parts.push(part);
    if (part.last) break;
  }
  burns.take(parts);
}
