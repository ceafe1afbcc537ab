// Estimates the gateway's clock. Frames carry the server's time, which the browser's clock does not share. The gateway
// shares the server's clock if both run on one machine; otherwise the offset of their clocks adds to the age of a frame.

const SAMPLES = 16;

export class GatewayClock {
  readonly #samples: { roundTripMs: number; offsetMs: number }[] = [];

  /** Adds an exchange: sent and received on this clock [ms], answered on the gateway's [ms since the Unix epoch]. */
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

  /** Time from the end of the server's step to `nowMs` on this clock [ms]; null before the first exchange. */
  ageMs(serverTimeNs: bigint, nowMs: number): number | null {
    const best = this.#best();
    return best === null ? null : Math.max(0, nowMs + best.offsetMs - Number(serverTimeNs) / 1e6);
  }

  /** Uncertainty of ages [ms]: half of the round trip, because the split between its two ways is unknown. */
  uncertaintyMs(): number | null {
    const best = this.#best();
    return best === null ? null : best.roundTripMs / 2;
  }

  // The exchange with the shortest round trip bounds the asymmetry of its two ways best.
  #best(): { roundTripMs: number; offsetMs: number } | null {
    return this.#samples.reduce<{ roundTripMs: number; offsetMs: number } | null>(
      (best, sample) => (best === null || sample.roundTripMs < best.roundTripMs ? sample : best),
      null,
    );
  }
}
