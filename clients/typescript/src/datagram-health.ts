// Whether datagrams get through. Each end counts its own, and says which of the other's was the newest that came: so each
// knows whether it is heard. While it is, poses go by datagram; else by calls. A network that blocks datagrams is no error.

/** Datagrams carry while the server has confirmed a new one within this time. */
const CONFIRMED_MS = 100;
/** A datagram goes out at least this often. */
const LIFE_MS = 40;

/** This end's account. */
export class DatagramHealth {
  sent = 0n;
  came = 0n;
  /** How often datagrams stopped getting through. */
  fellBack = 0;
  private sentMs = -Infinity;
  private newest = 0n;
  private confirmed = 0n;
  private confirmedMs = -Infinity;
  private carried = false;

  /** The numbers of a datagram that is sent now. */
  send(nowMs: number): { number: bigint; acknowledges: bigint } {
    this.sentMs = nowMs;
    return { number: (this.sent += 1n), acknowledges: this.newest };
  }

  /** Takes the arrival of the server's datagram `number`, which acknowledges one of this end's. */
  arrive(number: bigint, acknowledges: bigint, nowMs: number): void {
    this.came += 1n;
    if (number > this.newest) this.newest = number;
    // Nobody can have seen what was not sent.
    if (acknowledges <= this.confirmed || acknowledges > this.sent) return;
    this.confirmed = acknowledges;
    this.confirmedMs = nowMs;
  }

  /** Whether what is to be said now goes by datagram. */
  carries(nowMs: number): boolean {
    const carries = nowMs - this.confirmedMs <= CONFIRMED_MS;
    if (this.carried && !carries) this.fellBack += 1;
    return (this.carried = carries);
  }

  /** Whether a sign of life is due. */
  isSilent(nowMs: number): boolean {
    return nowMs - this.sentMs >= LIFE_MS;
  }
}
