// What a picture costs at each of the viewer's levels of quality, in a Chromium of 1280 x 800 that draws in software.
//
//     node tests/bench/quality_levels.mjs [PICTURES] > tests/bench/results/two-cores-quality.csv    (default: 40)
//
// It needs a built daemon, the built viewer and Chromium (CHROMIUM, default /usr/bin/chromium). The demo is paused, so the
// machine only draws. Reading back a pixel waits until a picture is done; where nothing was drawn, it does not wait, so the
// median says most. What the browser adds to show a picture is not in it.
import { spawn } from "node:child_process";
import { createRequire } from "node:module";
import { loadavg } from "node:os";
import { join } from "node:path";
import { createInterface } from "node:readline";

const ROOT = join(import.meta.dirname, "..", "..");
const { chromium } = createRequire(join(ROOT, "clients", "web", "package.json"))("playwright-core");
const PICTURES = Number(process.argv[2] ?? 40);
const FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking"];

/** In the page: times each turn of the drawing loop once `window.times` is there, and lets each one draw. */
function watch() {
  const open = window.HTMLCanvasElement.prototype.getContext;
  let gl = null;
  window.HTMLCanvasElement.prototype.getContext = function (...how) {
    const context = open.apply(this, how);
    gl = this.id === "view" ? context : gl;
    return context;
  };
  const request = window.requestAnimationFrame.bind(window);
  const pixel = new Uint8Array(4);
  window.requestAnimationFrame = (turn) =>
    request((nowMs) => {
      if (window.times === undefined) {
        turn(nowMs);
        return;
      }
      window.dispatchEvent(new window.Event("resize"));
      const began = performance.now();
      turn(nowMs);
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
      window.times.push(performance.now() - began);
    });
}

const run = spawn(join(ROOT, "build", "bin", "tensormass"), ["run", "demo", "--backend", "cpu"]);
const ended = new Promise((resolve) => run.once("exit", resolve));
const browser = await chromium.launch({ executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", args: FLAGS });
try {
  let url = null;
  for await (const line of createInterface(run.stdout)) {
    url = /viewer: (\S+)/.exec(line)?.[1] ?? null;
    if (url !== null) {
      break;
    }
  }
  const page = await (await browser.newContext({ viewport: { width: 1280, height: 800 } })).newPage();
  page.setDefaultTimeout(0);
  await page.addInitScript(watch);
  await page.goto(`${url}&quality=least`);
  await page.waitForFunction(() => window.tensormass.state().drawn > 0);
  await page.locator("#pause").click();
  const levels = await page.locator("#quality option").evaluateAll((options) => options.map(({ value }) => value));
  console.log("level,vertices,pictures,least_ms,median_ms,load_average");
  for (const level of levels.filter((name) => name !== "automatic")) {
    await page.goto(`${url}&quality=${level}`);
    await page.waitForFunction(() => window.tensormass.state().drawn > 0);
    await page.evaluate(() => (window.times = []));
    await page.waitForFunction((count) => window.times.length > count, PICTURES);
    const { times, vertices } = await page.evaluate(() => ({ times: window.times, vertices: window.tensormass.state().vertexCount }));
    // The first one compiles shaders.
    const sorted = times.slice(1).toSorted((a, b) => a - b);
    const [least, median] = [sorted[0], sorted[Math.floor(sorted.length / 2)]];
    console.log([level, vertices, sorted.length, least.toFixed(1), median.toFixed(1), loadavg()[0].toFixed(1)].join());
  }
} finally {
  await browser.close();
  run.kill("SIGINT");
  await ended;
}
