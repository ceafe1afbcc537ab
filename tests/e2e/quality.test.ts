// The level of quality that the page chooses on slow and quick machines, in Chromium on the built page.
import { afterAll, afterEach, beforeAll, describe, expect, it } from "vitest";

import { Browser, Stack, missing } from "./harness";

const absent = missing();
if (absent.length > 0) {
  console.warn(`skipped: not there: ${absent.join(", ")}`);
}

/** Turns of the drawing loop on machines that draw 5 and 100 pictures a second. */
const SLOW_MS = 200;
const QUICK_MS = 10;

describe.skipIf(absent.length > 0)("quality", () => {
  const browser = new Browser();
  let stack: Stack;
  let url: string;
  let vertexCount: number;

  const open = (turnMs: number, parameters = "") => browser.open(`${url}&scene=cube${parameters}`, turnMs);

  beforeAll(async () => {
    ({ stack, url } = await Stack.start());
    vertexCount = (await stack.ask("load_grid", { name: "cube", cells: 12 })) as number;
  });

  afterEach(async ({ task }) => {
    const errors = await browser.closePages(task.result?.state === "fail");
    expect(errors).toEqual([]);
  });

  afterAll(async () => {
    await browser.close();
    await stack.stop();
  });

  it("draws less on a slow machine, asks for fewer triangles, and says so in Display", async () => {
    const page = await open(SLOW_MS);
    await page.drawsAt("least");
    await page.page.waitForFunction((whole) => {
      const { vertexCount: shown } = window.tensormass.state();
      return shown > 0 && shown < whole / 2;
    }, vertexCount);
    await page.draws(3);
    await page.page.locator("#display > summary").click();
    // A turn draws only if a frame has come since the last one, so there are at most as many pictures as turns.
    await page.says("#quality-note", /^Now least: simple drew [1-5] pictures a second here\.$/);
    expect(await page.page.locator("#quality").inputValue()).toBe("automatic");
    expect(Number(await page.page.evaluate(() => document.documentElement.dataset.framesPerSecond))).toBeGreaterThan(0);
    expect((await page.state()).refused).toBe(0);
  });

  it("draws more on a quick machine, and keeps the camera", async () => {
    const page = await open(QUICK_MS);
    await page.shows(vertexCount);
    const corner = [1, 1, 1];
    const framed = (await page.project(corner))!;
    /** Waits until the corner is far from where the page first had it. */
    const moved = () =>
      page.page.waitForFunction(
        ([at, { x, y }]) => {
          const now = window.tensormass.project(at)!;
          return Math.hypot(now.x - x, now.y - y) > 20;
        },
        [corner, framed] as const,
      );
    await page.page.mouse.move(480, 300);
    await page.page.mouse.wheel(0, -400);
    await moved();
    await page.drawsAt("low");
    await page.draws(2);
    await moved();
    expect((await page.state()).vertexCount).toBe(vertexCount);
  });

  it("stays at the level that the user chose in Display, also after a reload", async () => {
    const page = await open(SLOW_MS, "&quality=coarse");
    await page.drawsAt("coarse");
    await page.page.locator("#display > summary").click();
    await page.page.locator("#quality").selectOption("simple");
    await page.drawsAt("simple");
    await page.shows(vertexCount);
    await page.draws(30);
    await page.says("#quality-note", /^Fixed at simple\.$/);
    expect(await page.page.evaluate(() => document.documentElement.dataset.quality)).toBe("simple");

    await page.page.reload();
    await page.shows(vertexCount);
    await page.draws(10);
    expect(await page.page.locator("#quality").inputValue()).toBe("simple");
    expect(await page.page.evaluate(() => document.documentElement.dataset.quality)).toBe("simple");
  });

  it("draws at each level, and lets the address say which triangles are sent", async () => {
    const page = await open(SLOW_MS, "&detail=1");
    await page.shows(vertexCount);
    await page.page.locator("#display > summary").click();
    // `medium` differs from the others in multisampling, for which WebGL starts again.
    for (const level of ["low", "medium", "least", "automatic"]) {
      await page.page.locator("#quality").selectOption(level);
      await page.draws(2);
      expect((await page.state()).vertexCount).toBe(vertexCount);
    }
    await page.drawsAt("least");
  });

  it("says which qualities there are, if the address asks for another one", async () => {
    const page = await open(QUICK_MS, "&quality=best");
    await page.says("#toast", /quality "best"; take one of automatic, high, .*least/);
  });
});
