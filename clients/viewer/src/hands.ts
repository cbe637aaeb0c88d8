// The two hands of the page: which one is chosen, and which leads a tool of the session.

import type { Hand } from "./hand";

/** Numbers of the hands. */
export type HandNumber = 0 | 1;
/** Names of the hands. */
export const HAND_NAMES = ["First hand", "Second hand"] as const;

export class Hands {
  /** Called when another hand is chosen, or both are in use from now on. */
  onChoice: () => void = () => {};
  private chosenNumber: HandNumber = 0;
  private isDouble = false;

  constructor(readonly both: readonly [Hand, Hand]) {}

  /** The hand that mouse, keys and the first finger lead, and that the controls set. */
  get chosen(): Hand {
    return this.both[this.chosenNumber];
  }

  get other(): Hand {
    return this.both[this.chosenNumber === 0 ? 1 : 0];
  }

  get number(): HandNumber {
    return this.chosenNumber;
  }

  choose(number: HandNumber): void {
    if (number === 1) this.isTwo = true;
    this.chosenNumber = number;
    this.onChoice();
  }

  /** Whether the user leads both. The second begins with the tool of the first, and lets go when it is no longer used. */
  get isTwo(): boolean {
    return this.isDouble;
  }

  set isTwo(on: boolean) {
    if (on === this.isDouble) return;
    this.isDouble = on;
    const [first, second] = this.both;
    if (on) [second.mode, second.strength] = [first.mode, first.strength];
    else void second.letGo();
    if (!on) this.chosenNumber = 0;
    this.onChoice();
  }

  /** Takes over the choices of the hands of another session. */
  follow(former: Hands): void {
    this.isDouble = former.isTwo;
    this.chosenNumber = former.number;
    this.both.forEach((hand, number) => {
      const { mode, strength } = former.both[number]!;
      [hand.mode, hand.strength] = [mode, strength];
    });
  }

  /** Parks the chosen hand's tool and chooses the other hand, or ends the stay of a parked one. */
  park(): void {
    const { chosen } = this;
    if (!chosen.touches) return;
    const stays = !chosen.isParked;
    chosen.isParked = stays;
    if (stays) this.choose(this.chosenNumber === 0 ? 1 : 0);
    else chosen.lift();
  }

  /** The hand that holds a tool of the session, if any. */
  of(tool: number): Hand | undefined {
    return this.both.find((hand) => hand.holds && hand.tool.has(tool));
  }

  /** A hand that holds its tool: the chosen one if both do. */
  get holding(): Hand | undefined {
    return [this.chosen, this.other].find(({ holds }) => holds);
  }

  /** Releases the tools of both. */
  async letGo(): Promise<void> {
    await Promise.all(this.both.map((hand) => hand.letGo()));
  }
}
