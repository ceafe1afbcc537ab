// Runs Chromium on scenes whose bodies look different: with a picture, and with strands between them.
import type { PNG } from "pngjs";
import { afterAll, afterEach, beforeAll, describe, expect, it } from "vitest";

import { Browser, Stack, difference, endTest, missing } from "./harness";

const absent = missing();
if (absent.length > 0) {
  console.warn(`skipped: not there: ${absent.join(", ")}`);
}

/** The colour that is more than twice as strong as the others at a point of a picture; none without one. */
function strongest(picture: PNG, at: { x: number; y: number }): string {
  const from = 4 * (Math.round(at.y) * picture.width + Math.round(at.x));
  const channels = [...picture.data.subarray(from, from + 3)];
  const most = Math.max(...channels);
  return channels.filter((channel) => 2 * channel > most).length === 1 ? ["red", "green", "blue"][channels.indexOf(most)]! : "none";
}

describe.skipIf(absent.length > 0)("bodies", () => {
  const browser = new Browser();
  let stack: Stack;
  let url: string;

  const open = (parameters: string) => browser.open(`${url}&quality=low&${parameters}`);

  beforeAll(async () => {
    ({ stack, url } = await Stack.start());
  });

  afterEach(({ task }) => endTest(browser, stack, task.result?.state === "fail"));

  afterAll(async () => {
    await browser.close();
    await stack.stop();
  });

  it("shows the picture on a body", async () => {
    const vertexCount = (await stack.ask("load_picture", { name: "pictured" })) as number;
    const page = await open("scene=pictured");
    await page.shows(vertexCount);
    const left = (await page.project([0.25, 0, 0.5]))!;
    const right = (await page.project([0.75, 0, 0.5]))!;
    // The picture is decoded some time after the first frame.
    await expect
      .poll(async () => {
        const picture = await page.picture();
        return [strongest(picture, left), strongest(picture, right)];
      })
      .toEqual(["red", "blue"]);
    await stack.ask("unload", { name: "pictured" });
  });

  it("draws attachments as strands until they break, in each codec and detail", async () => {
    const vertexCount = (await stack.ask("load_hanging", { name: "hanging" })) as number;
    let page = await open("scene=hanging");
    await page.shows(vertexCount);
    const strands = (count: number) => page.page.waitForFunction((all) => window.tensormass.state().strands === all, count);
    await strands(25);
    const shown = await page.picture();
    await page.page.keyboard.press("l");
    await strands(0);
    const between = (x: number, y: number) => x > 250 && y < 560;
    expect(difference(shown, await page.picture(), between)).toBeGreaterThan(0.1);
    await page.page.keyboard.press("l");
    await strands(25);

    await stack.ask("step", { name: "hanging", count: 30 });
    await strands(9);
    expect((await page.state()).refused).toBe(0);
    await page.close();

    // Whoever comes now never saw them break.
    for (const choice of ["codec=float32", "codec=meshopt", "codec=delta&detail=0.5"]) {
      page = await open(`scene=hanging&${choice}`);
      await strands(9);
      expect(page.errors).toEqual([]);
      await page.close();
    }
    page = await open("scene=hanging");
    await strands(9);
    await stack.ask("reset", { name: "hanging" });
    await strands(25);
    await stack.ask("unload", { name: "hanging" });
  });
});
