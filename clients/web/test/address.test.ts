import { afterEach, describe, expect, it, vi } from "vitest";

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

describe("entering", () => {
  afterEach(() => vi.unstubAllGlobals());
  const answering = (status: number) => {
    const post = vi.fn(() => Promise.resolve(new Response(null, { status })));
    vi.stubGlobal("fetch", post);
    return post;
  };

  it("changes a code into a cookie and leaves it out of every address", async () => {
    const post = answering(204);
    const address = new Address("http://host:1/?code=c&scene=a");
    expect(await address.enter()).toBe("http://host:1/?scene=a");
    expect(post).toHaveBeenCalledWith("//host:1/enter", { method: "POST", body: '{"code":"c","token":""}' });
    expect(address.stream).toBe("ws://host:1/stream?codec=q16");
  });

  it("drops a code that was used: a reload has the cookie", async () => {
    answering(403);
    expect(await new Address("http://host:1/?code=c").enter()).toBe("http://host:1/");
  });

  it("keeps a wrong token, so that the gateway says what is wrong", async () => {
    answering(403);
    const address = new Address("http://host:1/?token=t");
    expect(await address.enter()).toBeNull();
    expect(address.stream).toContain("token=t");
  });

  it("asks for nothing without either", async () => {
    const post = answering(204);
    expect(await new Address("http://host:1/?scene=a").enter()).toBeNull();
    expect(post).not.toHaveBeenCalled();
  });
});
