// Adds and removes tools in Chromium on the built page, with a daemon and the gateway behind it.
import { afterAll, afterEach, beforeAll, describe, expect, it } from "vitest";

import { Browser, Stack, difference, endTest, missing } from "./harness";

const absent = missing();
if (absent.length > 0) {
  console.warn(`skipped: not there: ${absent.join(", ")}`);
}

describe.skipIf(absent.length > 0)("tools", () => {
  const browser = new Browser();
  let stack: Stack;
  let url: string;

  beforeAll(async () => {
    ({ stack, url } = await Stack.start());
  });

  afterEach(({ task }) => endTest(browser, stack, task.result?.state === "fail"));

  afterAll(async () => {
    await browser.close();
    await stack.stop();
  });

  it("adds a tool and removes it, which fades out", async () => {
    const vertexCount = (await stack.ask("load_grid", { name: "tools", cells: 2, turned_tool: true })) as number;
    const page = await browser.open(`${url}&quality=low&scene=tools`);
    await page.shows(vertexCount);
    await page.page.locator("#tools-menu > summary").click();
    await page.says("#tools-list", /probe/);
    await page.page.locator("#tool-kind").selectOption("rod");
    expect(await page.page.locator("#tool-name").inputValue()).toBe("rod");
    await page.page.locator("#tool-add").click();
    await page.page.waitForFunction(() => window.tensormass.state().tools.some(({ name }) => name === "rod"));
    await page.says("#tools-list", /rod/);
    // The server's own words for a name that is taken.
    await page.page.locator("#tool-name").fill("probe");
    await page.page.locator("#tool-add").click();
    await page.says("#tools-note", /Adding probe: .*the scene has a tool 'probe' already/);
    await page.draws(2);
    const withRod = await page.picture();

    await page.page.getByRole("button", { name: "Remove rod" }).click();
    await page.page.waitForFunction(() => !window.tensormass.state().tools.some(({ name }) => name === "rod"));
    // The picture is as it was before only once the tool has faded out.
    await page.page.waitForTimeout(1500);
    await page.draws(2);
    const without = await page.picture();
    expect(difference(withRod, without, () => true)).toBeGreaterThan(0.1);
    expect(await page.page.locator("#tools-list li").allInnerTexts()).toEqual([expect.stringContaining("probe")]);
    await stack.ask("unload", { name: "tools" });
  });
});
