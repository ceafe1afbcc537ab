// Runs Chromium on a recording that `tensormass view` plays, without a daemon.
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { open as openFile } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";

import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers, protobufFromBinaryDescriptor } from "@mcap/support";
import { afterAll, afterEach, beforeAll, describe, expect, it } from "vitest";

import { Browser, RecordingView, difference, missing, record, type ViewerPage } from "./harness";

const absent = missing();
if (absent.length > 0) {
  console.warn(`skipped: not there: ${absent.join(", ")}`);
}

const SECONDS = 3;
/** Nodes on the surface of 4 × 4 × 4 cells. */
const CUBE_VERTICES = 5 ** 3 - 3 ** 3;
// A soft cube with a probe pressed into it. It sags under its weight after a second, because a busy machine may miss the
// first frames.
const SCENE = `
name: cube
gravity_m_per_s2: {z: -9.81}
gravity_schedule: {time_s: [1, 1.1], factor: [0, 1]}
bodies:
  - name: cube
    mesh: {grid: {size_m: {x: 0.1, y: 0.1, z: 0.1}, cells_x: 4, cells_y: 4, cells_z: 4}}
    law: {hooke: {young_modulus_pa: 3000, poisson_ratio: 0.3}}
    density_kg_per_m3: 1000
    fixed: [{box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}}]
tools:
  - name: probe
    spherical_probe: {radius_m: 0.02}
    position_m: {x: 0.05, y: 0.05, z: 0.11}
`;

describe.skipIf(absent.length > 0)("recording", () => {
  const browser = new Browser();
  const folder = mkdtempSync(join(tmpdir(), "tensormass-recording-"));
  let recording: string;
  let view: RecordingView | null = null;

  const open = async (address: string) => {
    const viewer = await browser.open(`${address}&quality=low`);
    await viewer.page.waitForFunction(() => window.tensormass.state().drawn > 0);
    return viewer;
  };

  /** Drags the handle to a share of the bar. */
  const dragTo = async (page: ViewerPage, share: number) => {
    const box = (await page.page.locator("#seek").boundingBox())!;
    const middle = box.y + box.height / 2;
    await page.drag({ x: box.x + 8, y: middle }, { x: box.x + share * box.width, y: middle });
  };

  /** Waits until the page shows another step than `step`. */
  const leaves = (page: ViewerPage, step: number | null) =>
    page.page.waitForFunction((old) => window.tensormass.state().step !== old, step);

  beforeAll(async () => {
    recording = await record(SCENE, folder, SECONDS);
  });

  afterEach(async ({ task }) => {
    const errors = await browser.closePages(task.result?.state === "fail");
    await view?.stop();
    view = null;
    expect(errors).toEqual([]);
  });

  afterAll(async () => {
    await browser.close();
    rmSync(folder, { recursive: true, force: true });
  });

  it("shows another step and another shape where the handle is dragged, and plays from there", async () => {
    view = await RecordingView.start(recording);
    const page = await open(view.url);
    await page.says("#link", /Paused/);
    await page.says("#timeline-time", /^0\.00 \/ \d+\.\d\d s$/);
    expect(await page.page.locator("#restart").isVisible()).toBe(false);
    expect(await page.page.locator("#grid").isVisible()).toBe(false);
    await page.page.locator("#marks button[data-kind=contact]").first().waitFor();
    const first = await page.state();
    const [before, still] = [await page.picture(), await page.picture()];

    await dragTo(page, 0.5);
    await leaves(page, first.step);
    const [timeS, durationS] = (await page.page.locator("#timeline-time").textContent())!.split("/").map(parseFloat);
    expect(timeS! / durationS!).toBeCloseTo(0.5, 1);
    const noise = difference(before, still, () => true);
    expect(difference(before, await page.picture(), () => true)).toBeGreaterThan(Math.max(0.1, 20 * noise));

    const middle = (await page.state()).step!;
    await page.page.keyboard.press("ArrowRight");
    await leaves(page, middle);
    await page.page.keyboard.press("ArrowLeft");
    await page.page.waitForFunction((old) => window.tensormass.state().step === old, middle);
    await page.says("#timeline-step", new RegExp(`^step ${middle}$`));

    await page.page.locator("#speed").selectOption("2");
    await page.page.keyboard.press("Tab"); // a list keeps the space key
    await page.page.locator("#play").click();
    await page.says("#link", /Ended/);
    expect((await page.state()).step!).toBeGreaterThan(middle);
    expect((await page.state()).refused).toBe(0);
    await page.page.keyboard.press("Home");
    await page.says("#timeline-time", /^0\.00 \//);
  });

  it("is read by a public library of another language, which knows nothing of its messages", async () => {
    const handle = await openFile(recording);
    const decompressHandlers = await loadDecompressHandlers();
    const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(handle), decompressHandlers });
    const counts = new Map<string, number>();
    let frame: Record<string, unknown> = {};
    for await (const message of reader.readMessages()) {
      const { topic, schemaId } = reader.channelsById.get(message.channelId)!;
      counts.set(topic, (counts.get(topic) ?? 0) + 1);
      if (topic === "/frames") {
        const { name, data } = reader.schemasById.get(schemaId)!;
        frame = protobufFromBinaryDescriptor(data).lookupType(name).decode(message.data).toJSON();
      }
    }
    await handle.close();
    expect(counts.get("/scene")).toBe(1);
    expect(counts.get("/inputs")).toBeGreaterThan(60);
    expect(Number(frame.step)).toBeGreaterThan(0);
    expect(Buffer.from(frame.positions as string, "base64").length).toBe(CUBE_VERTICES * 3 * Float32Array.BYTES_PER_ELEMENT);
  });

  it("says that a file was cut off, and lets lookers look only", async () => {
    const cut = join(folder, "cut.mcap");
    const whole = readFileSync(recording);
    writeFileSync(cut, whole.subarray(0, Math.floor(0.6 * whole.length)));
    view = await RecordingView.start(cut);
    const page = await open(view.lookUrl);
    await page.says("#notice", /was cut off\. It is shown up to its last whole chunk, at \d\.\d\d s/);
    for (const control of ["#play", "#seek", "#frame-forward", "#speed"]) {
      expect(await page.page.locator(control).isDisabled()).toBe(true);
    }
  });

  it.each([
    { width: 380, height: 600 },
    { width: 900, height: 420 },
    { width: 1280, height: 800 },
  ])("keeps the time line apart from the readings in a window of $width x $height", async (size) => {
    view = await RecordingView.start(recording);
    const page = await open(view.url);
    await page.page.setViewportSize(size);
    const boxes = await page.page.evaluate(() =>
      ["#timeline", "aside", "#display > summary", "#seek", "#speed", "#timeline-where"].map((selector) =>
        document.querySelector(selector)!.getBoundingClientRect().toJSON() as DOMRect,
      ),
    );
    const [timeline, readings, display, ...parts] = boxes as [DOMRect, DOMRect, DOMRect, DOMRect, DOMRect, DOMRect];
    expect(timeline.bottom).toBeLessThanOrEqual(size.height);
    expect(readings.bottom).toBeLessThanOrEqual(timeline.top);
    expect(display.bottom).toBeLessThanOrEqual(timeline.top);
    expect(parts.every((part) => part.left >= timeline.left && part.right <= timeline.right)).toBe(true);
    expect(parts[0].width).toBeGreaterThan(100);
  });
});
