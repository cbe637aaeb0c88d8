// What tips burn of the surface: asks the server for what is new, and shows it.

import { Burns, followBurns } from "palpate";
import { server, sleep } from "./server";
import type { Surface } from "./surface";
import { VersionFollower } from "./version-follower";

/** Interval between two requests. */
const ASK_MS = 100;

export class Burning {
  burns: Burns;
  private readonly follower: VersionFollower;

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
    this.follower = new VersionFollower((newest) => this.isReused || this.burns.version < newest, () => this.ask(), signal);
  }

  /** Shows burns on another surface of the same tissue. */
  refine(surface: Surface, refinement: number): void {
    [this.surface, this.refinement, this.burns] = [surface, refinement, new Burns(surface.vertexCount)];
    void this.follower.follow();
  }

  /** The server has told of this version. */
  heard(version: number): void {
    this.follower.heard(version);
  }

  private async ask(): Promise<void> {
    const { burns, surface, signal } = this;
    await followBurns(server, this.sessionId, this.refinement, burns, signal);
    // Another refinement has other vertices.
    if (signal.aborted || burns !== this.burns) return;
    this.isReused = false;
    surface.showBurns(burns.burn);
    this.onShown();
    await sleep(ASK_MS, signal);
  }
}
