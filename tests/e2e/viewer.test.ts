// A real Chromium on the real page, with the real daemon behind it.
import { afterAll, afterEach, beforeAll, describe, expect, it } from "vitest";

import { Browser, Stack, difference, missing, type ViewerPage } from "./harness";

const absent = missing();
if (absent.length > 0) {
  console.warn(`skipped: not there: ${absent.join(", ")}`);
}

const PRESS_DEPTH_M = 0.015;
/** Around the probe, and beyond where its dent is felt [CSS pixels]. */
const NEAR_PX = 35;
const FAR_PX = 230;

describe.skipIf(absent.length > 0)("viewer", () => {
  const browser = new Browser();
  let stack: Stack;
  let url: string;
  let viewer: ViewerPage | null = null;

  const open = async (parameters: string) => {
    viewer = await browser.open(`${url}&quality=low&${parameters}`);
    return viewer;
  };

  beforeAll(async () => {
    ({ stack, url } = await Stack.start());
  });

  afterEach(async () => {
    // A page that threw has failed, whatever else it shows.
    expect(viewer?.errors ?? []).toEqual([]);
    await viewer?.close();
    viewer = null;
  });

  afterAll(async () => {
    await browser.close();
    await stack.stop();
  });

  it("shows the organ give way where the probe presses, and only there", async () => {
    const vertexCount = (await stack.ask("load", { scene: "demo", name: "pressed" })) as number;
    await stack.ask("settle", { name: "pressed" });
    const page = await open("scene=pressed");
    await page.shows(vertexCount);
    // The tissue, not the tool, is to differ.
    await page.page.keyboard.press("t");
    await page.draws(2);
    const before = await page.picture();
    await page.draws(2);
    const still = await page.picture();

    const { contact_m, force_n } = (await stack.ask("press", { name: "pressed", depth_m: PRESS_DEPTH_M })) as {
      contact_m: number[];
      force_n: number;
    };
    await page.draws(2);
    const under = await page.picture();
    const at = await page.project(contact_m);
    expect(at).not.toBeNull();
    const distance = (x: number, y: number) => Math.hypot(x - at!.x, y - at!.y);
    const near = (x: number, y: number) => distance(x, y) < NEAR_PX;
    const far = (x: number, y: number) => distance(x, y) > FAR_PX;

    const noise = difference(before, still, () => true);
    const pressed = { near: difference(before, under, near), far: difference(before, under, far) };
    console.info("mean difference of pixels:", { noise, ...pressed }, `under ${force_n.toFixed(2)} N`);
    expect(pressed.near).toBeGreaterThan(2);
    expect(pressed.near).toBeGreaterThan(20 * Math.max(noise, pressed.far));

    await page.page.keyboard.press("t");
    const label = page.page.locator("#labels .force");
    await label.waitFor();
    expect(parseFloat((await label.textContent()) ?? "")).toBeCloseTo(force_n, 1);

    // The gateway of this test lets browsers move tools: the pointer takes the probe away again.
    const { tools } = await page.state();
    const held = await page.project(tools[0]!.positionM);
    expect(held).not.toBeNull();
    await page.drag(held!, { x: held!.x, y: held!.y - 90 });
    await page.page.locator("#labels .force").waitFor({ state: "detached" });
    const lifted = (await page.state()).tools[0]!;
    expect(lifted.positionM[2]).toBeGreaterThan(tools[0]!.positionM[2] + PRESS_DEPTH_M);
    expect((await page.state()).refused).toBe(0);
    await stack.ask("unload", { name: "pressed" });
  });

  it("follows a scene that is loaded anew with another topology, and offers all scenes", async () => {
    const small = (await stack.ask("load_grid", { name: "cube", cells: 2 })) as number;
    const page = await open("scene=cube");
    await page.shows(small);
    await page.says("#link", /Live/);

    await stack.ask("unload", { name: "cube" });
    await page.says("#notice", /no scene "cube"/);
    const large = (await stack.ask("load_grid", { name: "cube", cells: 5 })) as number;
    expect(large).toBeGreaterThan(small);
    await page.shows(large);

    const other = (await stack.ask("load_grid", { name: "other", cells: 3 })) as number;
    await page.page.locator("#scene option[value=other]").waitFor({ state: "attached" });
    await page.page.locator("#scene").selectOption("other");
    await page.shows(other);
    expect(new URL(page.page.url()).searchParams.get("scene")).toBe("other");
    await stack.ask("unload", { name: "other" });
    await stack.ask("unload", { name: "cube" });
  });

  it("survives the daemon", async () => {
    const before = (await stack.ask("load_grid", { name: "cube", cells: 2 })) as number;
    const page = await open("scene=cube");
    await page.shows(before);

    await stack.ask("stop_daemon");
    await page.says("#notice", /Waiting for the daemon/);
    expect((await page.state()).vertexCount).toBe(0);

    await stack.ask("start_daemon");
    await page.says("#notice", /no scene "cube"/);
    const after = (await stack.ask("load_grid", { name: "cube", cells: 4 })) as number;
    await page.shows(after);
    await page.says("#link", /Live/);
    await stack.ask("unload", { name: "cube" });
  });

  it("says that a token is wrong", async () => {
    const wrong = new URL(url);
    wrong.searchParams.set("token", "another");
    viewer = await browser.open(wrong.href);
    await viewer.says("#notice", /the token is missing or wrong/);
  });
});
