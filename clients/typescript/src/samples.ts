// Samples: what the tools feel, as the server streams it.

import type { Sample } from "./gen/palpate/v1/haptic_pb.js";
import { type Failure, keepOpen, type Server } from "./server.js";

/**
 * Calls `onSample` with the samples of all tools of a session, at an interval in steps, until `signal` aborts.
 * Reconnects after failures. Ignores samples from a server that no longer owns the session.
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
