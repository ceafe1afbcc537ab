import { expect, it } from "vitest";

import { Address } from "../src/address";

it("remembers the scene and the grid, and keeps the rest", () => {
  const address = new Address("http://host:1/?token=t&quality=low&scene=liver");
  expect([address.scene, address.grid, address.quality]).toEqual(["liver", false, "low"]);
  expect(address.with("kidney", true)).toBe("http://host:1/?token=t&quality=low&scene=kidney&grid=1");
  expect([address.scene, address.grid]).toEqual(["kidney", true]);
  expect(address.with(null, false)).toBe("http://host:1/?token=t&quality=low");
});

it("asks for streams with the token and the chosen frames", () => {
  expect(new Address("http://host:1/?token=t&scene=a").stream).toBe("ws://host:1/stream?token=t&codec=q16");
  expect(new Address("https://host/?token=t&rate_hz=30&codec=delta&detail=0.5").stream).toBe(
    "wss://host/stream?token=t&codec=delta&rate_hz=30&detail=0.5",
  );
});
