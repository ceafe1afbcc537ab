import { expect, it } from "vitest";

import { GatewayClock } from "../src/stream/clock";

it("knows no age before the first exchange", () => {
  expect(new GatewayClock().ageMs(1n, 0)).toBeNull();
});

it("computes the age from the gateway's clock", () => {
  const clock = new GatewayClock();
  clock.add(100, 104, 1_000_002); // the gateway is 999,900 ms ahead
  expect(clock.ageMs(1_000_000_000_000n, 112)).toBe(12);
  expect(clock.uncertaintyMs()).toBe(2);
});

it("uses the exchange with the shortest round trip", () => {
  const clock = new GatewayClock();
  clock.add(0, 2, 1001);
  clock.add(10, 90, 1085); // delayed on one way only: 35 ms off
  expect(clock.ageMs(1_000_000_000n, 20)).toBe(20);
});

it("forgets old exchanges, because clocks drift", () => {
  const clock = new GatewayClock();
  clock.add(0, 0, 1000);
  for (let k = 1; k <= 16; k += 1) {
    clock.add(k, k + 1, 2000.5 + k);
  }
  expect(clock.ageMs(2_000_000_000n, 20)).toBe(20);
});

it("ignores impossible exchanges", () => {
  const clock = new GatewayClock();
  clock.add(10, 5, 1000);
  clock.add(1, 2, NaN);
  expect(clock.uncertaintyMs()).toBeNull();
});

it("never reports a negative age", () => {
  const clock = new GatewayClock();
  clock.add(0, 0, 1000);
  expect(clock.ageMs(1_500_000_000n, 0)).toBe(0);
});
