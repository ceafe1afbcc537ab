// Runs Chromium on the built page, with a daemon and the gateway behind it.
import { stat } from "node:fs/promises";

import { afterAll, afterEach, beforeAll, describe, expect, it } from "vitest";

import { Browser, Stack, difference, endTest, missing } from "./harness";

const absent = missing();
if (absent.length > 0) {
  console.warn(`skipped: not there: ${absent.join(", ")}`);
}

const PRESS_DEPTH_M = 0.015;
/** Radii around the probe: its dent, and the distance beyond which the tissue does not move [CSS pixels]. */
const NEAR_PX = 35;
const FAR_PX = 230;

/** True if two boxes of the page do not overlap. */
function apart(a: DOMRect, b: DOMRect): boolean {
  return a.right <= b.left || b.right <= a.left || a.bottom <= b.top || b.bottom <= a.top;
}

describe.skipIf(absent.length > 0)("viewer", () => {
  const browser = new Browser();
  let stack: Stack;
  let url: string;
  let lookUrl: string;

  const open = (parameters: string) => browser.open(`${url}&quality=low&${parameters}`);

  beforeAll(async () => {
    ({ stack, url, lookUrl } = await Stack.start());
  });

  afterEach(({ task }) => endTest(browser, stack, task.result?.state === "fail"));

  afterAll(async () => {
    await browser.close();
    await stack.stop();
  });

  it("shows the organ deform where the probe presses, and only there", async () => {
    const vertexCount = (await stack.ask("load", { scene: "demo", name: "pressed" })) as number;
    await stack.ask("settle", { name: "pressed" });
    const page = await open("scene=pressed");
    await page.shows(vertexCount);
    // Without tools, so that only the tissue can differ.
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
    const label = page.page.locator(".force");
    await label.waitFor();
    expect(parseFloat((await label.textContent()) ?? "")).toBeCloseTo(force_n, 1);

    // The gateway of this test lets browsers move tools, so the pointer can lift the probe off.
    const { tools } = await page.state();
    const held = await page.project(tools[0]!.positionM);
    expect(held).not.toBeNull();
    await page.drag(held!, { x: held!.x, y: held!.y - 90 });
    await page.page.locator(".force").waitFor({ state: "detached" });
    // The force ends when the tool leaves the tissue, while the tool is still moving.
    const free = tools[0]!.positionM[2] + PRESS_DEPTH_M;
    await page.page.waitForFunction((least) => window.tensormass.state().tools[0]!.positionM[2] > least, free);
    expect((await page.state()).refused).toBe(0);
    await stack.ask("unload", { name: "pressed" });
  });

  it("follows a scene that is reloaded with another topology, and lists all scenes", async () => {
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

  it("shows frames in each codec, and says why a choice of frames is refused", async () => {
    const vertexCount = (await stack.ask("load_grid", { name: "coded", cells: 3 })) as number;
    for (const choice of ["codec=float32", "codec=q16", "codec=delta&normals=true&rate_hz=30", "codec=meshopt"]) {
      const page = await open(`scene=coded&${choice}`);
      await page.shows(vertexCount);
      await page.draws(3);
      expect((await page.state()).refused).toBe(0);
      expect(page.errors).toEqual([]);
      await page.close();
    }
    const less = await open("scene=coded&codec=meshopt&detail=0.5");
    await less.page.waitForFunction((whole) => {
      const { vertexCount } = window.tensormass.state();
      return vertexCount > 0 && vertexCount < whole;
    }, vertexCount);
    await less.draws(3);
    expect((await less.state()).refused).toBe(0);
    expect(less.errors).toEqual([]);
    await less.close();
    const page = await open("scene=coded&codec=h264");
    await page.says("#notice", /codec 'h264' is unknown; take one of float32, q16, delta, meshopt/);
    await stack.ask("unload", { name: "coded" });
  });

  it("reconnects after a crash of the daemon", async () => {
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
    const viewer = await browser.open(wrong.href);
    await viewer.says("#notice", /Not let in.*the token is missing or wrong/s);
    await viewer.says("#link", /Refused/);
  });

  it("says that its origin is refused", async () => {
    const named = new URL(url);
    named.hostname = "viewer.localhost"; // resolves without DNS and is not one of the gateway's names
    const viewer = await browser.open(named.href);
    await viewer.says("#notice", /Origin http:\/\/viewer\.localhost:\d+ is not let in; allow it with --origin/);
  });

  it("says that the gateway is full, and connects once it is not", async () => {
    const others = [await browser.open(url), await browser.open(url)];
    for (const other of others) {
      await other.says("#link", /No scene/);
    }
    const viewer = await browser.open(url);
    await viewer.says("#notice", /2 browsers are connected/);
    await others[0]!.close();
    await viewer.says("#link", /No scene/);
    await others[1]!.close();
  });

  it("is live only while frames arrive", async () => {
    const vertexCount = (await stack.ask("load_grid", { name: "cube", cells: 2 })) as number;
    await stack.ask("load_grid", { name: "blind", cells: 2, frame_rate_hz: 0 });
    const page = await open("scene=cube");
    await page.shows(vertexCount);
    await page.says("#link", /Live/);
    await stack.ask("pause", { name: "cube" });
    await page.says("#link", /Paused/);
    expect(await page.page.locator("#notice").isVisible()).toBe(false);
    await page.page.locator("#scene").selectOption("blind");
    await page.says("#notice", /sends no frames/);
    await page.says("#link", /No frames/);
    await stack.ask("unload", { name: "blind" });
    await stack.ask("unload", { name: "cube" });
  });

  it("says that a scene in lockstep waits for requests", async () => {
    const vertexCount = (await stack.ask("load_grid", { name: "locked", cells: 2, lockstep: true })) as number;
    const page = await open("scene=locked");
    await page.shows(vertexCount);
    await page.says("#link", /^Lockstep$/);
    await page.says("#target", /^in lockstep$/);
    // The frame on show dates from the load, so its age says nothing.
    await page.says("#drawn", /[1-9]/);
    expect(await page.page.locator("#latency").textContent()).toBe("–");
    await stack.ask("step", { name: "locked", count: 1 });
    await page.says("#latency", /^[\d.]+$/);
    await stack.ask("unload", { name: "locked" });
  });

  it("shows no numbers of a status that newer frames have outdated", async () => {
    await stack.ask("load_grid", { name: "silent", cells: 2, status_rate_hz: 0 }); // one status, at the load
    const page = await open("scene=silent");
    await page.says("#link", /Live/);
    await page.says("#target", /^of 60 Hz$/);
    await page.says("#physics", /^–$/);
    await page.says("#step-time", /^–$/);
    await stack.ask("unload", { name: "silent" });
  });

  it("moves a rotated tool and keeps its orientation", async () => {
    const vertexCount = (await stack.ask("load_grid", { name: "turned", cells: 2, turned_tool: true })) as number;
    const page = await open("scene=turned");
    await page.shows(vertexCount);
    const before = (await page.state()).tools[0]!;
    // The tip is 0.4 m along the tool's z axis, which points along -y here.
    const [x, y, z] = before.positionM;
    const held = await page.project([x, y - 0.4, z]);
    expect(held).not.toBeNull();
    await page.drag(held!, { x: held!.x, y: held!.y - 40 });
    await page.page.waitForFunction((from) => window.tensormass.state().tools[0]!.positionM[2] > from + 0.05, z);
    const after = (await page.state()).tools[0]!;
    expect(after.orientationWxyz).toEqual(before.orientationWxyz.map((value) => expect.closeTo(value) as number));
    // The tool must move up in the plane that faces the camera, without a jump by its own length.
    expect(Math.abs(after.positionM[0] - x)).toBeLessThan(0.05);
    expect(Math.abs(after.positionM[1] - y)).toBeLessThan(0.3);
    await stack.ask("unload", { name: "turned" });
  });

  it("pauses, steps, resumes and resets a scene for an operator", async () => {
    const vertexCount = (await stack.ask("load_grid", { name: "cube", cells: 2 })) as number;
    const page = await open("scene=cube");
    await page.shows(vertexCount);
    await page.says("#link", /Live/);
    expect(await page.page.locator("#step").getAttribute("title")).toMatch(/A scene that runs does not step/);
    await page.page.locator("#pause").click();
    await page.says("#link", /Paused/);
    const paused = (await page.state()).step!;
    expect(paused).toBeGreaterThan(0);
    await page.page.locator("#step").click();
    await page.page.waitForFunction((step) => window.tensormass.state().step === step + 1, paused);
    await page.says("#link", /Paused/);

    await page.page.keyboard.press("Home");
    await page.page.waitForFunction(() => window.tensormass.state().step === 0);
    await page.says("#link", /Paused/);
    await page.page.locator("#pause").click();
    await page.says("#link", /Live/);
    await page.page.waitForFunction(() => window.tensormass.state().step! > 0);
    await stack.ask("unload", { name: "cube" });
  });

  it("changes the stiffness of a running scene by a slider", async () => {
    const vertexCount = (await stack.ask("load_grid", { name: "cube", cells: 2 })) as number;
    const page = await open("scene=cube");
    await page.shows(vertexCount);
    await page.page.keyboard.press("m");
    const stiffness = page.page.getByRole("slider", { name: "Stiffness of" });
    await stiffness.waitFor();
    const { step, topologyVersion } = await page.state();
    await stiffness.focus();
    await page.page.keyboard.press("End");
    await page.says("#material-sliders output", /× 10/);
    await page.page.waitForFunction((from) => window.tensormass.state().step! > from + 60, step!);
    expect((await page.state()).topologyVersion).toBe(topologyVersion);

    // The daemon has the value, not only this page.
    await page.page.reload();
    await page.shows(vertexCount);
    await page.page.locator("#material > summary").click();
    await page.says("#material-sliders output", /× 10/);
    await stack.ask("unload", { name: "cube" });
  });

  it("films a running scene", async () => {
    const vertexCount = (await stack.ask("load_grid", { name: "cube", cells: 2 })) as number;
    const page = await open("scene=cube");
    await page.shows(vertexCount);
    await page.page.locator("#display > summary").click();
    await page.page.locator("#film").click();
    const { step } = await page.state();
    await page.page.waitForFunction((from) => window.tensormass.state().step! > from + 60, step!);
    const [film] = await Promise.all([page.page.waitForEvent("download"), page.page.locator("#film").click()]);
    expect(film.suggestedFilename()).toMatch(/^tensormass-cube-[\d.]+s\.webm$/);
    expect((await stat(await film.path())).size).toBeGreaterThan(1_000); // a busy machine draws few pictures
    await stack.ask("unload", { name: "cube" });
  });

  it("loads a built-in scene to step by hand, colours it by displacement and stress, and unloads it", async () => {
    const page = await open("scene=nothing");
    await page.says("#notice", /no scene "nothing"\..*(Load one with \+ in the header|Choose one in the header, or load another one with \+)\./s);
    await page.page.locator("#scenes > summary").click();
    await page.page.locator("#builtin").selectOption("cantilever");
    await page.page.locator("#lockstep").check();
    await page.page.locator("#load").click();
    await page.says("#link", /^Lockstep$/);
    expect(new URL(page.page.url()).searchParams.get("scene")).toBe("cantilever");
    await page.page.waitForFunction(() => window.tensormass.state().step === 0);
    const before = await page.picture();

    await page.page.keyboard.press("c");
    await page.says(".legend-title", /^Displacement from rest$/);
    const unmoved = await page.picture();
    await page.page.locator("#step").click();
    await page.page.waitForFunction(() => window.tensormass.state().step === 1);
    await page.says(".legend-ticks", /mm$/);
    const bent = await page.picture();
    const inside = (x: number, y: number) => x > 250 && y < 560;
    expect(difference(before, unmoved, inside)).toBeGreaterThan(1);
    expect(difference(unmoved, bent, inside)).toBeGreaterThan(1);
    await page.page.keyboard.press("n");
    expect(difference(bent, await page.picture(), inside)).toBeGreaterThan(0.01); // dots at the fixed nodes
    await page.page.keyboard.press("n");

    await page.page.locator("#display > summary").click();
    await page.page.locator("#colouring").selectOption("von_mises");
    await page.says(".legend-title", /^Von Mises stress$/);
    await page.says(".legend-ticks", /Pa$/);
    await page.page.locator("#clip-axis").selectOption("x");
    expect(difference(bent, await page.picture(), inside)).toBeGreaterThan(1);
    const [saved] = await Promise.all([page.page.waitForEvent("download"), page.page.locator("#picture").click()]);
    expect(saved.suggestedFilename()).toMatch(/^tensormass-cantilever-[\d.]+s\.png$/);

    // The page remembers its display.
    await page.page.reload();
    await page.says(".legend-title", /^Von Mises stress$/);
    expect(await page.page.locator("#clip-axis").inputValue()).toBe("x");

    await page.page.keyboard.press("Escape");
    await page.page.locator("#scenes > summary").click();
    await page.page.locator("#unload").click();
    await page.says("#notice", /The daemon has no scene/);
  });

  it("shows an operator why a command failed", async () => {
    const vertexCount = (await stack.ask("load_grid", { name: "cube", cells: 2 })) as number;
    const page = await open("scene=cube");
    await page.shows(vertexCount);
    await page.says("#link", /Live/);
    // A list that is older than the gateway.
    await page.page.evaluate(() => {
      Object.defineProperty(document.querySelector("#builtin"), "value", { value: "missing" });
    });
    await page.page.locator("#scenes > summary").click();
    await page.page.locator("#load").click();
    await page.says("#toast", /load missing: there is no built-in scene 'missing'/);
    await page.page.keyboard.press("Escape");
    await page.page.locator("#toast").waitFor({ state: "hidden" });
    await stack.ask("unload", { name: "cube" });
  });

  it("disables the controls, with a reason, for who only looks", async () => {
    await stack.ask("load_grid", { name: "cube", cells: 2, turned_tool: true });
    const viewer = await browser.open(`${lookUrl}&quality=low&scene=cube`);
    await viewer.says("#link", /Live/);
    for (const id of ["pause", "step", "restart", "load", "unload"]) {
      const button = viewer.page.locator(`#${id}`);
      expect(await button.isDisabled()).toBe(true);
      expect(await button.getAttribute("title")).toMatch(/only lets you look/);
    }
    await viewer.page.keyboard.press(" ");
    await viewer.draws(2);
    await viewer.says("#link", /Live/);
    await stack.ask("unload", { name: "cube" });
  });

  it("shows that a tool can be dragged", async () => {
    const vertexCount = (await stack.ask("load_grid", { name: "turned", cells: 2, turned_tool: true })) as number;
    const page = await open("scene=turned");
    await page.page.setViewportSize({ width: 1200, height: 640 });
    await page.shows(vertexCount);
    await page.draws(2);
    const [x, y, z] = (await page.state()).tools[0]!.positionM;
    const at = await page.project([x, y - 0.4, z]);
    await page.page.mouse.move(at!.x, at!.y);
    // The browser hands pointer events to the page with its next picture.
    const showsCursor = (cursor: string) =>
      page.page.waitForFunction((name) => getComputedStyle(document.querySelector(".tile")!).cursor === name, cursor);
    await showsCursor("grab");
    await page.says("#hint", /Drag to move this tool/);
    await page.page.mouse.down();
    await showsCursor("grabbing");
    await page.page.mouse.up();
    await page.page.mouse.move(at!.x, 100);
    await showsCursor("auto");
    await stack.ask("unload", { name: "turned" });
  });

  it("shows that a scene recovers, and counts it, until the scene goes on", async () => {
    const vertexCount = (await stack.ask("load_recovering", { name: "recovers" })) as number;
    const page = await open("scene=recovers");
    await page.shows(vertexCount);
    const badge = page.page.locator("#recovering");
    await badge.waitFor({ state: "visible" });
    await page.says("#recoveries-row", /Recoveries\s*1\s*1 step/);
    await page.page.locator("#grid").click();
    const ofTile = page.page.locator(".tile .recovery");
    await ofTile.waitFor({ state: "visible" });
    await stack.ask("lift_off", { name: "recovers" });
    await badge.waitFor({ state: "hidden" });
    await ofTile.waitFor({ state: "hidden" });
    await page.says("#recoveries", /^1$/);
    await stack.ask("unload", { name: "recovers" });
  });

  it("shows two scenes in a grid, acts on the selected one, and shows it alone", async () => {
    const [one, two] = ["one", "two"];
    const vertexCount = (await stack.ask("load_grid", { name: one, cells: 2 })) as number;
    const other = (await stack.ask("load_grid", { name: two, cells: 4 })) as number;
    const page = await open("scene=one");
    await page.shows(vertexCount);
    await page.page.locator("#grid").click();
    await page.showsTiles(one, two);
    const tile = (name: string) => page.page.locator(".tile").filter({ hasText: name });
    const pill = (name: string) => tile(name).locator(".state");
    const inside = async (name: string) => {
      const box = (await tile(name).boundingBox())!;
      return (x: number, y: number) => x > box.x + 4 && x < box.x + box.width - 4 && y > box.y + 4 && y < box.y + box.height - 4;
    };

    // A drag turns the scene of its tile only, and selects it.
    const before = await page.picture();
    const { x, y, width, height } = (await tile(two).boundingBox())!;
    const middle = { x: x + width / 2, y: y + height / 2 };
    await page.drag(middle, { x: middle.x + 60, y: middle.y });
    await page.page.waitForTimeout(1000); // the camera glides on
    const after = await page.picture();
    expect(difference(before, after, await inside(two))).toBeGreaterThan(1);
    expect(difference(before, after, await inside(one))).toBeLessThan(0.1);
    expect(await page.page.locator("#scene").inputValue()).toBe(two);
    expect((await page.state()).vertexCount).toBe(other);

    // Keys act on the selected scene. Enter selects, too.
    await page.page.keyboard.press(" ");
    await page.says("#link", /Paused/);
    await pill(two).filter({ hasText: "Paused" }).waitFor();
    expect(await pill(one).textContent()).toBe("Live");
    await tile(one).focus();
    await page.page.keyboard.press("Enter");
    await page.says("#link", /Live/);
    expect(await tile(one).getAttribute("aria-current")).toBe("true");

    // The address remembers grid and selection. Tiles follow the scenes.
    expect(new URL(page.page.url()).search).toMatch(/scene=one&grid=1$/);
    await page.page.reload();
    await page.showsTiles(one, two);
    await stack.ask("unload", { name: two });
    await page.showsTiles(one);
    await stack.ask("load_grid", { name: two, cells: 4 });
    await page.showsTiles(one, two);
    expect((await page.state()).scene).toBe(one);

    // A phone has one column.
    await page.page.setViewportSize({ width: 390, height: 844 });
    await expect.poll(async () => (await tile(one).boundingBox())!.width).toBeGreaterThan(300);
    const [upper, lower] = [(await tile(one).boundingBox())!, (await tile(two).boundingBox())!];
    expect(lower.x).toBe(upper.x);
    expect(lower.y).toBeGreaterThanOrEqual(upper.y + upper.height);

    await tile(two).dblclick();
    await page.showsTiles(two);
    expect(await tile(two).boundingBox()).toEqual({ x: 0, y: 0, width: 390, height: 844 });
    await page.page.keyboard.press("g");
    await page.showsTiles(one, two);
    await page.page.keyboard.press("g");
    await page.showsTiles(two);
    await stack.ask("unload", { name: one });
    await stack.ask("unload", { name: two });
  });

  it("lets the user close a notice and open it again", async () => {
    await stack.ask("load", { scene: "beam", name: "broken" }); // faults without help
    const page = await open("scene=broken");
    await page.says("#link", /Stopped/);
    const notice = page.page.locator("#notice");
    await page.says("#notice", /Scene stopped.*Reset the scene/s);
    await page.page.keyboard.press("Escape");
    await notice.waitFor({ state: "hidden" });
    await page.page.locator("#link").click();
    await notice.waitFor();
    await page.page.getByRole("button", { name: "Hide this notice" }).click();
    await notice.waitFor({ state: "hidden" });
    // The page rewrites the notice a few times a second. It must stay closed, and the keyboard must open it again.
    await page.page.waitForTimeout(600);
    expect(await notice.isVisible()).toBe(false);
    await page.says("#link", /Stopped/);
    await page.page.keyboard.press("Enter");
    await notice.waitFor();
    await stack.ask("unload", { name: "broken" });
  });

  it("shows the scene's findings on request, over no other control", async () => {
    // No step meets this budget.
    await stack.ask("load_grid", { name: "hasty", cells: 2, budget_s: 1e-6 });
    const page = await open("scene=hasty");
    await page.says("#findings-count", /^[12] findings?$/);
    const badge = await page.page.locator("#findings-count").boundingBox();
    for (const control of await page.page.locator("header :is(button, select, .menu > summary):visible").all()) {
      const box = await control.boundingBox();
      if (badge === null || box === null || (await control.getAttribute("id")) === "findings-count") continue;
      expect(box.x + box.width <= badge.x || badge.x + badge.width <= box.x).toBe(true);
    }
    expect(await page.page.locator("#findings-list").isVisible()).toBe(false);
    await page.page.locator("#findings-count").press("Enter");
    await page.says("#findings-list", /steps take [\d.e-]+ s of a budget of 1e-06 s/);
    await page.page.keyboard.press("Escape");
    expect(await page.page.locator("#findings-list").isVisible()).toBe(false);
    await stack.ask("unload", { name: "hasty" });
    await page.page.locator("#findings").waitFor({ state: "hidden" });
  });

  it.each([
    { width: 420, height: 800 },
    { width: 420, height: 320 },
    { width: 380, height: 600 },
    { width: 900, height: 420 },
    { width: 960, height: 640 },
  ])("keeps everything in sight in a window of $width x $height", async (size) => {
    const names = ["a", "b"].map((letter) => letter.repeat(64));
    for (const name of names) {
      await stack.ask("load_grid", { name, cells: 2 });
    }
    const page = await open(`scene=${names[0]!}`);
    await page.page.setViewportSize(size);
    await page.says("#link", /Live/);
    // In one evaluation, because the page rewrites the notice a few times a second.
    const { link, picker, panel, tools, notice, close, scrolls } = await page.page.evaluate(() => {
      const shown = document.querySelector<HTMLElement>("#notice")!;
      shown.hidden = false;
      shown.querySelector("#notice-detail")!.textContent = "the fault of a scene in many words ".repeat(20);
      const box = (selector: string) => document.querySelector(selector)!.getBoundingClientRect();
      return {
        link: box("#link"),
        picker: box("#scene"),
        panel: box("aside"),
        tools: box("#display > summary"),
        notice: box("#notice"),
        close: box("#notice-close"),
        scrolls: shown.scrollHeight > shown.clientHeight,
      };
    });
    expect(link.right).toBeLessThanOrEqual(size.width);
    expect(picker.width).toBeGreaterThan(40);
    expect(picker.right).toBeLessThanOrEqual(link.left);
    expect(tools.top).toBeGreaterThanOrEqual(link.bottom);
    expect(apart(tools, panel)).toBe(true);
    expect(panel.height).toBeGreaterThan(60);
    expect(panel.bottom).toBeLessThanOrEqual(size.height);
    // The notice covers neither the readings nor the buttons nor the middle of the picture, and can be closed.
    expect(notice.width).toBeCloseTo(Math.min(380, size.width - 44));
    expect(notice.right).toBeLessThanOrEqual(size.width);
    expect(notice.top).toBeGreaterThanOrEqual(link.bottom);
    expect([panel, tools].every((box) => apart(notice, box))).toBe(true);
    expect(notice.left > size.width / 2 || notice.bottom < size.height / 2 + 10).toBe(true);
    expect([close.left >= notice.left, close.right <= notice.right, close.top >= notice.top]).toEqual([true, true, true]);
    expect(scrolls).toBe(size.width < 860);
    for (const menu of ["#display", "#material"]) {
      await page.page.locator(`${menu} > summary`).click();
      const sheet = (await page.page.locator(`${menu} > .sheet`).boundingBox())!;
      expect([menu, sheet.x >= 0, sheet.x + sheet.width <= size.width]).toEqual([menu, true, true]);
      await page.page.keyboard.press("Escape");
    }
    for (const name of names) {
      await stack.ask("unload", { name });
    }
  });
});
