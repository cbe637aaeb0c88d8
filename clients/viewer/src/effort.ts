// Adapts the rendering effort to the time available.

/** Effort levels, the greatest first. The lighting is the same in all. */
export const EFFORTS = [
  { pixels: 1, every: 1 },
  { pixels: 0.75, every: 1 },
  { pixels: 0.75, every: 2 },
  { pixels: 0.55, every: 2 },
  { pixels: 0.45, every: 4 },
] as const satisfies { pixels: number; every: number }[];

/** Pictures that take longer than this are late, ms: with a graphics processor, and with software rendering. */
const LATE_MS = { hardware: 45, software: 40 };
/** After this much lateness in consecutive pictures, the effort is reduced. */
const DEBT_MS = 150;
/** A longer time than this was not spent on a picture: the window was hidden, or the machine asleep. */
const PAUSE_MS = 5000;
/** After this time without a late picture a greater effort is tried; the time doubles after each failed try. */
const RETRY_MS = { least: 4000, most: 128_000 };

export class Effort {
  private index: number;
  private readonly lateMs: number;
  private debtMs = 0;
  private lateOnes = 0;
  private wellMs = 0;
  private patienceMs = RETRY_MS.least;
  private isFirst = true;

  /** With `isFixed`, always uses the greatest effort, however long a picture takes. */
  constructor(
    private readonly isSoftware: boolean,
    private readonly isFixed: boolean,
  ) {
    this.lateMs = isSoftware ? LATE_MS.software : LATE_MS.hardware;
    this.index = isSoftware && !isFixed ? 2 : 0;
  }

  get now(): (typeof EFFORTS)[number] {
    return EFFORTS[this.index]!;
  }

  /** Records the time a picture took. Returns true if the next one has another effort. */
  tell(tookMs: number): boolean {
    // The first picture includes compiling programs and filling buffers.
    const isFirst = this.isFirst;
    this.isFirst = false;
    if (this.isFixed || isFirst || tookMs > PAUSE_MS) return false;
    const isLate = tookMs > this.lateMs;
    this.debtMs = Math.max(0, this.debtMs + tookMs - this.lateMs);
    this.lateOnes = isLate ? this.lateOnes + 1 : 0;
    this.wellMs = isLate ? 0 : this.wellMs + tookMs;
    if (this.lateOnes >= 2 && this.debtMs > DEBT_MS) {
      const steps = Math.max(1, Math.floor(Math.log2(tookMs / this.lateMs)));
      return this.change(Math.min(this.index + steps, EFFORTS.length - 1));
    }
    if (this.wellMs < this.patienceMs || this.index === 0) return false;
    // If the greater effort fails, the next try is later.
    this.patienceMs = Math.min(2 * this.patienceMs, RETRY_MS.most);
    return this.change(this.index - 1);
  }

  private change(index: number): boolean {
    [this.debtMs, this.lateOnes, this.wellMs] = [0, 0, 0];
    if (index === this.index) return false;
    this.index = index;
    this.isFirst = true;
    return true;
  }

  /** Text for the status line: what is reduced. */
  describe(every: number): string {
    const { pixels } = this.now;
    const less = [
      pixels < 1 ? `${Math.round(100 * pixels)} % of the pixels a side` : "",
      every > 1 ? `1 vertex in ${every} a side` : "",
      this.isSoftware ? "no graphics processor" : "",
    ].filter((what) => what !== "");
    return less.join(", ") || "in full";
  }
}

/** Whether the processor draws the pictures, judged by the renderer's name. */
export function isDrawnBySoftware(): boolean {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return false;
  const names = gl.getExtension("WEBGL_debug_renderer_info");
  const name = String(gl.getParameter(names?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER));
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}
