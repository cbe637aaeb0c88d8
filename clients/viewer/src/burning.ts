// What tips burn of the surface: asks the server for what is new, one request at a time, and shows it.

import { Burns, followBurns } from "palpate";
import { isUnimplemented, server, sleep } from "./server";
import type { Surface } from "./surface";

/** Interval between two requests. */
const ASK_MS = 100;
/** Interval after a request that failed. */
const RETRY_MS = 1000;

export class Burning {
  burns: Burns;
  /** The newest version that the server has told of. */
  private newest = 0;
  private isAsking = false;
  /** Whether this server's burns can be shown. */
  private canAsk = true;

  /** With `isReused`, the surface may show the burns of another session. */
  constructor(
    private readonly sessionId: string,
    private surface: Surface,
    private refinement: number,
    private isReused: boolean,
    private readonly signal: AbortSignal,
    private readonly onShown: () => void,
  ) {
    this.burns = new Burns(surface.vertexCount);
  }

  /** Shows burns on another surface of the same tissue. */
  refine(surface: Surface, refinement: number): void {
    [this.surface, this.refinement, this.burns] = [surface, refinement, new Burns(surface.vertexCount)];
    void this.follow();
  }

  /** The server has told of this version. */
  heard(version: number): void {
    this.newest = Math.max(this.newest, version);
    void this.follow();
  }

  private get isBehind(): boolean {
    return this.isReused || this.burns.version < this.newest;
  }

  private async follow(): Promise<void> {
    if (this.isAsking || !this.canAsk) return;
    this.isAsking = true;
    try {
      while (!this.signal.aborted && this.isBehind) {
        const { burns, surface } = this;
        await followBurns(server, this.sessionId, this.refinement, burns, this.signal);
        if (this.signal.aborted) return;
        // Another refinement has other vertices.
        if (burns !== this.burns) continue;
        this.isReused = false;
        surface.showBurns(burns.burn);
        this.onShown();
        await sleep(ASK_MS, this.signal);
      }
    } catch (error) {
      this.canAsk = !(error instanceof RangeError || isUnimplemented(error));
      // Another failure is told by the streams, and a later frame asks again.
      await sleep(RETRY_MS, this.signal);
    } finally {
      this.isAsking = false;
    }
  }
}
