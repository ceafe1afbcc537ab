// The gateway's clock as seen from here. Frames carry the server's time, the browser's clock is another: the age of a
// frame is only known through the gateway, which shares its clock with the server if both run on one machine (else
// their offset adds to the age).

const SAMPLES = 16;

export class GatewayClock {
  readonly #samples: { roundTripMs: number; offsetMs: number }[] = [];

  /** One exchange: sent and received on this clock, answered on the gateway's [ms since the Unix epoch]. */
  add(sentMs: number, receivedMs: number, gatewayMs: number): void {
    const roundTripMs = receivedMs - sentMs;
    if (!(roundTripMs >= 0) || !Number.isFinite(gatewayMs)) {
      return;
    }
    this.#samples.push({ roundTripMs, offsetMs: gatewayMs - (sentMs + receivedMs) / 2 });
    if (this.#samples.length > SAMPLES) {
      this.#samples.shift();
    }
  }

  /** From the end of the server's step to `nowMs` on this clock [ms]; null before the first exchange. */
  ageMs(serverTimeNs: bigint, nowMs: number): number | null {
    const best = this.#best();
    return best === null ? null : Math.max(0, nowMs + best.offsetMs - Number(serverTimeNs) / 1e6);
  }

  /** Ages are known to within this [ms]: nobody knows how the round trip was shared by its two ways. */
  uncertaintyMs(): number | null {
    const best = this.#best();
    return best === null ? null : best.roundTripMs / 2;
  }

  // The exchange with the least delay has the least room for asymmetry.
  #best(): { roundTripMs: number; offsetMs: number } | null {
    return this.#samples.reduce<{ roundTripMs: number; offsetMs: number } | null>(
      (best, sample) => (best === null || sample.roundTripMs < best.roundTripMs ? sample : best),
      null,
    );
  }
}
