import { expect, it } from "vitest";

import { Address } from "../src/address";

it("remembers the scene and the grid, and keeps the rest", () => {
  const address = new Address("http://host:1/?token=t&quality=low&scene=liver");
  expect([address.scene, address.grid, address.quality]).toEqual(["liver", false, "low"]);
  expect(address.with("kidney", true)).toBe("http://host:1/?token=t&quality=low&scene=kidney&grid=1");
  expect([address.scene, address.grid]).toEqual(["kidney", true]);
  expect(address.with(null, false)).toBe("http://host:1/?token=t&quality=low");
});

it("forgets a quality after another one was chosen in the page", () => {
  const address = new Address("http://host:1/?token=t&quality=low&scene=liver");
  expect(address.withoutQuality()).toBe("http://host:1/?token=t&scene=liver");
  expect(address.with("liver", false)).toBe("http://host:1/?token=t&scene=liver");
});

it("leaves to a level of quality what it does not choose itself", () => {
  const level = { detail: 0.5, rateHz: 30 };
  expect(new Address("http://host:1/?token=t").framesOf(level)).toEqual({ detail: 0.5, rate_hz: 30 });
  expect(new Address("http://host:1/?token=t").framesOf({ detail: 1, rateHz: null })).toEqual({ detail: 1, rate_hz: null });
  expect(new Address("http://host:1/?token=t&detail=1").framesOf(level)).toEqual({ rate_hz: 30 });
  expect(new Address("http://host:1/?token=t&detail=0.1&rate_hz=60").framesOf(level)).toEqual({});
});

it("asks for streams with the token and the chosen frames", () => {
  expect(new Address("http://host:1/?token=t&scene=a").stream).toBe("ws://host:1/stream?token=t&codec=q16");
  expect(new Address("https://host/?token=t&rate_hz=30&codec=delta&detail=0.5").stream).toBe(
    "wss://host/stream?token=t&codec=delta&rate_hz=30&detail=0.5",
  );
});
