// Samples: what the tools feel, as the server streams it.

import type { Sample } from "./gen/palpate/v1/haptic_pb.js";
import { type Failure, keepOpen, type Server } from "./server.js";

/**
 * Tells the samples of all tools of a session, every so many steps, until `signal` aborts. Connects again when that breaks. Samples
 * of a server that does not have the session any more are left out.
 */
export function watchSamples(
  server: Server,
  sessionId: string,
  sampleEverySteps: number,
  onSample: (sample: Sample) => void,
  signal: AbortSignal,
  onFailure: (failure: Failure, waitMs: number) => void = () => {},
): Promise<void> {
  let revision = 0n;
  return keepOpen(
    async (signal, alive) => {
      for await (const { sample } of server.haptics.watchSamples({ sessionId, sampleEverySteps }, { signal })) {
        alive();
        if (!sample || sample.ownershipRevision < revision) continue;
        revision = sample.ownershipRevision;
        onSample(sample);
      }
    },
    signal,
    onFailure,
  );
}
