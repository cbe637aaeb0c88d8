// Determines whether datagrams get through. Each side numbers its datagrams, and reports the newest number that it
// received from the other side, so each side knows whether its datagrams arrive. While they do, poses are sent by
// datagram, otherwise by calls. A network that blocks datagrams is not an error.

/** Datagrams are used while the server has confirmed a new one within this time. */
const CONFIRMED_MS = 100;
/** Maximum interval between datagrams. */
const LIFE_MS = 40;

/** The datagrams of this side. */
export class DatagramHealth {
  sent = 0n;
  came = 0n;
  /** Number of times that datagrams stopped getting through. */
  fellBack = 0;
  private sentMs = -Infinity;
  private newest = 0n;
  private confirmed = 0n;
  private confirmedMs = -Infinity;
  private carried = false;

  /** Returns the numbers for a datagram that is sent now. */
  send(nowMs: number): { number: bigint; acknowledges: bigint } {
    this.sentMs = nowMs;
    return { number: (this.sent += 1n), acknowledges: this.newest };
  }

  /** Records the arrival of the server's datagram `number`, which acknowledges one of this side's datagrams. */
  arrive(number: bigint, acknowledges: bigint, nowMs: number): void {
    this.came += 1n;
    if (number > this.newest) this.newest = number;
    // The server can't have seen what was not sent.
    if (acknowledges <= this.confirmed || acknowledges > this.sent) return;
    this.confirmed = acknowledges;
    this.confirmedMs = nowMs;
  }

  /** Returns whether to use datagrams now. */
  carries(nowMs: number): boolean {
    const carries = nowMs - this.confirmedMs <= CONFIRMED_MS;
    if (this.carried && !carries) this.fellBack += 1;
    return (this.carried = carries);
  }

  /** Returns whether a keep-alive datagram is due. */
  isSilent(nowMs: number): boolean {
    return nowMs - this.sentMs >= LIFE_MS;
  }
}
