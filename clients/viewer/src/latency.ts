// Latency from a press to the visible change of a pixel, measured in the page on the picture itself.

import type { Stage } from "./stage";

/** Minimum change of a pixel, summed over red, green and blue: more than antialiasing causes. */
const SEEN = 6;

interface Watch {
  x: number;
  y: number;
  before: Uint8Array;
  pressedMs: number | undefined;
  done: (ms: number) => void;
}

export class Latency {
  private watch: Watch | undefined;

  constructor(private readonly stage: Stage) {}

  /** Resolves with the time from the next press to the change of the pixel at (x, y) of the window, ms. */
  next(x: number, y: number): Promise<number> {
    this.stage.hold(true);
    return new Promise((done) => {
      this.watch = { x, y, before: new Uint8Array(), pressedMs: undefined, done };
      this.stage.draw();
    });
  }

  /** Records a press, at the time that the browser reports. */
  pressed(eventMs: number): void {
    if (this.watch && this.watch.pressedMs === undefined) this.watch.pressedMs = eventMs;
  }

  /** Call after each picture. */
  drawn(): void {
    const watch = this.watch;
    if (!watch) return;
    const now = this.stage.pixel(watch.x, watch.y);
    if (watch.pressedMs === undefined || watch.before.length === 0) {
      watch.before = now;
      return;
    }
    const difference = [0, 1, 2].reduce((sum, i) => sum + Math.abs(now[i]! - watch.before[i]!), 0);
    if (difference < SEEN) return;
    this.watch = undefined;
    this.stage.hold(false);
    watch.done(performance.now() - watch.pressedMs);
  }
}
