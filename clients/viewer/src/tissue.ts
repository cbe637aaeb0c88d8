// Sliders for k, C and K″: factors on the scene's initial values. Commands are sent one at a time, the newest value
// last.

import { part } from "./page";
import { quantity } from "./plot";
import type { Scene, Session } from "palpate/v1";
import { describe, isUnimplemented, CALL_TIMEOUT_MS, sessions } from "./server";

interface Values {
  k: number;
  c: number;
  v: number;
}

const UNITS = { k: "N/m", c: "N·s/m", v: "N/m" };
const NAMES = ["k", "c", "v"] as const;

function valuesOf(scene: Scene | undefined): Values {
  return {
    k: scene?.springs?.stiffnessNPerM ?? 0,
    c: scene?.damping?.coefficientNSPerM ?? 0,
    v: scene?.anchorSprings?.stiffnessNPerM ?? 0,
  };
}

export class TissueValues {
  private readonly sliders = NAMES.map((name) => part(name, HTMLInputElement));
  private begun: Values = { k: 1, c: 1, v: 1 };
  /** The initial values, with 1 instead of 0, because a factor can't change 0. */
  private base: Values = this.begun;
  private sessionId = "";
  private wanted: Partial<Values> | undefined;
  private underWay = false;

  constructor(
    private readonly onSession: (session: Session) => void,
    private readonly onRefused: (message: string) => void,
  ) {
    NAMES.forEach((name, index) => {
      const slider = this.sliders[index]!;
      slider.addEventListener("input", () => this.set({ [name]: this.base[name] * 10 ** Number(slider.value) }));
    });
    part("original", HTMLButtonElement).addEventListener("click", () => this.set(this.begun));
  }

  /** Begins with another session: its present values become the middle of the sliders. */
  begin(session: Session): void {
    this.sessionId = session.sessionId;
    this.begun = valuesOf(session.scene);
    this.base = { k: this.begun.k || 1, c: this.begun.c || 1, v: this.begun.v || 1 };
    this.show(session);
  }

  /** Shows the session's values, unless a change has yet to be sent. */
  show(session: Session): void {
    if (this.underWay || this.wanted) return;
    const values = valuesOf(session.scene);
    NAMES.forEach((name, index) => {
      const slider = this.sliders[index]!;
      const factor = values[name] / this.base[name];
      if (document.activeElement !== slider || factor === 1) slider.value = String(factor > 0 ? Math.log10(factor) : -1);
      this.tell(name, values[name]);
    });
  }

  private tell(name: keyof Values, value: number): void {
    const text = quantity(value, UNITS[name]);
    part(`${name}-value`, HTMLOutputElement).value = text;
    part(name, HTMLInputElement).setAttribute("aria-valuetext", text);
  }

  private set(values: Partial<Values>): void {
    for (const name of NAMES) if (values[name] !== undefined) this.tell(name, values[name]);
    this.wanted = { ...this.wanted, ...values };
    if (!this.underWay) void this.send();
  }

  private async send(): Promise<void> {
    this.underWay = true;
    let newest: Session | undefined;
    while (this.wanted) {
      const { k, c, v } = this.wanted;
      this.wanted = undefined;
      const request = {
        sessionId: this.sessionId,
        stiffnessNPerM: k,
        dampingNSPerM: c,
        anchorStiffnessNPerM: v,
      };
      try {
        newest = (await sessions.updateTissue(request, { timeoutMs: CALL_TIMEOUT_MS })).session ?? newest;
      } catch (error) {
        this.onRefused(isUnimplemented(error) ? "This server can't change a running tissue." : describe(error));
        newest = (await sessions.getSession({ sessionId: this.sessionId }).catch(() => undefined))?.session ?? newest;
      }
    }
    this.underWay = false;
    if (newest?.sessionId === this.sessionId) {
      this.onSession(newest);
      this.show(newest);
    }
  }
}
