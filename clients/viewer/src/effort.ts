// How much work goes into a picture: as much as there is time for, and no more.

/** Efforts, the greatest first; each takes about two thirds of the time of the one before where there is no graphics processor. */
export const EFFORTS = [
  { pixels: 1, isPhysical: true, every: 1 },
  { pixels: 0.7, isPhysical: true, every: 1 },
  { pixels: 0.7, isPhysical: false, every: 1 },
  { pixels: 0.7, isPhysical: false, every: 2 },
  { pixels: 0.5, isPhysical: false, every: 2 },
  { pixels: 0.5, isPhysical: false, every: 4 },
] as const satisfies { pixels: number; isPhysical: boolean; every: number }[];

/** Pictures that take longer are late: where a processor of its own draws, and where it is ours (ms). */
const LATE_MS = { hardware: 45, software: 40 };
/** Late by so much in all, in pictures that follow one another, there are to be plainer ones. */
const DEBT_MS = 150;
/** What takes longer was no picture: the window was hidden, or the machine asleep. */
const PAUSE_MS = 5000;
/** After so long without a late picture a greater effort is tried; twice as long after each try that failed. */
const PATIENCE_MS = { least: 4000, most: 128_000 };

export class Effort {
  private index: number;
  private readonly lateMs: number;
  private debtMs = 0;
  private lateOnes = 0;
  private wellMs = 0;
  private patienceMs = PATIENCE_MS.least;
  private isFirst = true;

  /** `isFixed` keeps to the greatest, however long a picture takes. */
  constructor(
    private readonly isSoftware: boolean,
    private readonly isFixed: boolean,
  ) {
    this.lateMs = isSoftware ? LATE_MS.software : LATE_MS.hardware;
    this.index = isSoftware && !isFixed ? 3 : 0;
  }

  get now(): (typeof EFFORTS)[number] {
    return EFFORTS[this.index]!;
  }

  /** Takes in how long a picture took to come. True if the next is another effort. */
  tell(tookMs: number): boolean {
    // The first has programs to be compiled and buffers to be filled.
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
    // If it does not last, the next try is later.
    this.patienceMs = Math.min(2 * this.patienceMs, PATIENCE_MS.most);
    return this.change(this.index - 1);
  }

  private change(index: number): boolean {
    [this.debtMs, this.lateOnes, this.wellMs] = [0, 0, 0];
    if (index === this.index) return false;
    this.index = index;
    this.isFirst = true;
    return true;
  }

  /** For people: what is less than it could be. */
  describe(every: number): string {
    const { pixels, isPhysical } = this.now;
    const less = [
      pixels < 1 ? `${Math.round(100 * pixels)} % of the pixels a side` : "",
      every > 1 ? `1 vertex in ${every} a side` : "",
      isPhysical ? "" : "plain light",
      this.isSoftware ? "no graphics processor" : "",
    ].filter((what) => what !== "");
    return less.join(", ") || "in full";
  }
}

/** Whether pictures are drawn by the processor: by the name that what draws them gives itself. */
export function isDrawnBySoftware(): boolean {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return false;
  const names = gl.getExtension("WEBGL_debug_renderer_info");
  const name = String(gl.getParameter(names?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER));
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}
