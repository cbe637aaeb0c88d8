// Follows what the server tells of a surface by versions, as its wound and its burns: one request at a time, until it is as new as what frames have told.

import { isUnimplemented, sleep } from "./server";

/** Interval after a request that failed. */
const RETRY_MS = 1000;

export class VersionFollower {
  /** The newest version that the server has told of. */
  private newest = 0;
  private isAsking = false;
  /** Whether this server's answers can be shown. */
  private canAsk = true;

  /**
   * `isBehind` returns whether what is shown is older than a version; `ask` asks for what is new, shows it and waits until the next request may follow.
   */
  constructor(
    private readonly isBehind: (newest: number) => boolean,
    private readonly ask: () => Promise<void>,
    private readonly signal: AbortSignal,
  ) {}

  /** The server has told of this version. */
  heard(version: number): void {
    this.newest = Math.max(this.newest, version);
    void this.follow();
  }

  /** Asks, if what is shown has become older than what was told. */
  async follow(): Promise<void> {
    if (this.isAsking || !this.canAsk) return;
    this.isAsking = true;
    try {
      while (!this.signal.aborted && this.isBehind(this.newest)) await this.ask();
    } catch (error) {
      this.canAsk = !(error instanceof RangeError || isUnimplemented(error));
      // Another failure is told by the streams, and a later frame asks again.
      await sleep(RETRY_MS, this.signal);
    } finally {
      this.isAsking = false;
    }
  }
}
