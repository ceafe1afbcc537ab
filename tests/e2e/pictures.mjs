// Takes the pictures of docs/images: scenes under their scripted hands, as `tensormass run` shows them.
//
//     node tests/e2e/pictures.mjs retract grasp table
//
// It needs a built daemon, the built viewer and Chromium (CHROMIUM, default /usr/bin/chromium). A picture is taken when
// the force on the tool has been steady for a second.
import { spawn } from "node:child_process";
import { createRequire } from "node:module";
import { join } from "node:path";
import { createInterface } from "node:readline";

const ROOT = join(import.meta.dirname, "..", "..");
const { chromium } = createRequire(join(ROOT, "clients", "web", "package.json"))("playwright-core");
const LONGEST_WAIT_S = 60;
const LEAST_FORCE_N = 0.1;
const STEADY_N = 0.03;

/** Runs a scene until `visit` is done with the viewer's address. */
async function withScene(name, visit) {
  const run = spawn(join(ROOT, "build", "bin", "tensormass"), ["run", name, "--backend", "cpu"]);
  const ended = new Promise((resolve) => run.once("exit", resolve));
  try {
    let said = "";
    for await (const line of createInterface(run.stdout)) {
      said += `${line}\n`;
      const url = /viewer: (\S+)/.exec(line)?.[1];
      if (url !== undefined) {
        return await visit(url);
      }
    }
    throw new Error(`tensormass run ${name} shows no viewer:\n${said}`);
  } finally {
    run.kill("SIGINT");
    await ended;
  }
}

/** Hides the readings: they are those of a browser that draws in software. */
async function hideReadings(page) {
  await page.evaluate(() => {
    for (const element of document.querySelectorAll("aside, footer, #notice")) {
      element.style.visibility = "hidden";
    }
  });
}

/** Waits until the label of the force has stayed the same for a second. */
async function steady(page) {
  let last = null;
  let since = Date.now();
  for (const start = since; Date.now() - start < LONGEST_WAIT_S * 1000; await page.waitForTimeout(100)) {
    const force = Number.parseFloat((await page.locator("output.force").allTextContents())[0] ?? "0");
    if (last === null || Math.abs(force - last) > STEADY_N || force < LEAST_FORCE_N) {
      last = force;
      since = Date.now();
    } else if (Date.now() - since > 1000) {
      return;
    }
  }
  throw new Error(`no steady force above ${LEAST_FORCE_N} N within ${LONGEST_WAIT_S} s`);
}

const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking"],
});
try {
  for (const name of process.argv.slice(2)) {
    await withScene(name, async (url) => {
      const page = await browser.newPage({ viewport: { width: 960, height: 640 } });
      await page.goto(url);
      await steady(page);
      await hideReadings(page);
      const path = join(ROOT, "docs", "images", `${name}.jpg`);
      await page.screenshot({ path, type: "jpeg", quality: 85 });
      await page.close();
      console.log(path);
    });
  }
} finally {
  await browser.close();
}
