// Takes the pictures of docs/images: scenes under their scripted hands, as `tensormass run` shows them.
//
//     node tests/e2e/pictures.mjs [retract] [grasp] [table] [demo-abdomen] [dissect] [burn] [cut] [snip] [resect] [demo] [textured] [viewer] [grid] [timeline] [moving] [strip]
//
// The default is all of them.
//
// `viewer`, `grid` and `timeline` take those of docs/viewer.md, one for each state of the page. `demo` takes that of the
// README, `moving` its film (QUALITY=low for a slow machine), `strip` its strip, `textured` that of a picture on a skin.
// They need a built daemon, the built viewer and Chromium (CHROMIUM, default /usr/bin/chromium). A picture under a hand
// is taken when the force on the tool has been steady for a second.
import { spawn } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync, statSync } from "node:fs";
import { createRequire } from "node:module";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { createInterface } from "node:readline";

const ROOT = join(import.meta.dirname, "..", "..");
const { chromium } = createRequire(join(ROOT, "clients", "web", "package.json"))("playwright-core");
const HANDS = ["retract", "grasp", "table", "demo-abdomen"];
const PAGES = {
  burn: takeBurn,
  cut: takeCut,
  demo: takeDemo,
  dissect: takeDissect,
  snip: takeSnip,
  resect: takeResect,
  textured: takeTextured,
  viewer: takeViewer,
  grid: takeGrid,
  timeline: takeTimeline,
  moving: takeMoving,
  strip: takeStrip, // from pictures that are there
};
/** Scenes of the grid. `tensormass run` loads the first one. */
const TILES = ["retract", "grasp", "table", "two_organs"];
const RECORDED_S = 14;
/** Step of `burn` after which its hand draws back, and x that it then goes below [m]. */
const BURNT_STEP = 400;
const DRAWN_BACK_M = -0.105;
/** Step of `cut` in which its hand draws the edge through the organ. */
const CUT_STEP = 300;
/** Step of `resect` in which its grasper lets the piece go on the tray. */
const PUT_DOWN_STEP = 720;
/** Step of `snip` in which its scissors leave the lobe whose tip they took. */
const SNIPPED_STEP = 375;
const LONGEST_WAIT_S = 180;
const POLLING_MS = 250;
const QUALITY = process.env.QUALITY ?? "high";
const LEAST_FORCE_N = 0.1;
const STEADY_N = 0.03;
/** Force on the probe of `demo` at which its dent is seen. */
const PRESSED_N = 0.3;
/** The hook of `dissect` is in its second pass, or behind, with x below and y above these. */
const SECOND_PASS_M = [0.05, -0.02];
const MAX_PICTURE_BYTES = 100_000;
const WIDE = { width: 960, height: 640 };
const ROOMY = { width: 1280, height: 800 };
const PHONE = { width: 390, height: 844 };
/** The moving picture of the README: the window and its part that is seen, number of pictures, and time between two of them. */
const MOVING = {
  size: { width: 960, height: 600 },
  clip: { x: 160, y: 90, width: 640, height: 400 },
  pictures: 60,
  everyS: 0.1,
};
/** Pictures of the README's strip, side by side. */
const STRIP = ["grasp", "retract", "textured", "demo-abdomen"];
const STRIP_PICTURE = { width: 480, height: 320 };

/** Runs a command until `visit` is done with the groups of what `found` finds in its output. Then waits for its end. */
async function withCommand(args, found, visit) {
  const run = spawn(join(ROOT, "build", "bin", "tensormass"), args);
  const ended = new Promise((resolve) => run.once("exit", resolve));
  try {
    let said = "";
    for await (const line of createInterface(run.stdout)) {
      said += `${line}\n`;
      const groups = found.exec(said);
      if (groups !== null) {
        return await visit(...groups.slice(1));
      }
    }
    throw new Error(`tensormass ${args.join(" ")} does not say ${found}:\n${said}`);
  } finally {
    run.kill("SIGINT");
    await ended;
  }
}

/** Runs a scene until `visit` is done with the viewer's address. */
function withScene(name, visit) {
  return withCommand(["run", name, "--backend", "cpu", "--no-fit"], /viewer: (\S+)/, visit);
}

/** Records a scene under its scripted hand, which takes some seconds. */
async function recordHand(name, file, seconds) {
  const script = join(ROOT, "clients", "python", "tensormass", "scenes", "hands", `${name}.yaml`);
  await withCommand(["record", name, "--frames", "--backend", "cpu", "-o", file], /control (\S+)/, async (control) => {
    const hand = spawn(join(ROOT, "build", "bin", "tensormass"), ["hand", script, "--server", control, "--scene", name]);
    const ended = new Promise((resolve) => hand.once("exit", resolve));
    await new Promise((resolve) => setTimeout(resolve, 1000 * seconds));
    hand.kill("SIGINT");
    await ended;
  });
}

/** Opens the page in a window of its own, with the display options `settings`. */
async function open(url, size, settings = {}, quality = "low") {
  const context = await browser.newContext({ viewport: size });
  context.setDefaultTimeout(LONGEST_WAIT_S * 1000);
  const page = await context.newPage();
  await page.addInitScript((text) => window.localStorage.setItem("tensormass.display", text), JSON.stringify(settings));
  // A given quality does not adapt the resolution to the software renderer.
  await page.goto(`${url}&quality=${quality}`);
  return page;
}

/** Waits until an element of the page shows a text. */
function says(page, selector, text) {
  return page.locator(selector).filter({ hasText: text, visible: true }).waitFor();
}

/** Saves the picture and closes the page. */
async function save(page, name) {
  const path = join(ROOT, "docs", "images", `${name}.jpg`);
  await page.screenshot({ path, type: "jpeg", quality: 80 });
  await page.context().close();
  const bytes = statSync(path).size;
  if (bytes > MAX_PICTURE_BYTES) {
    throw new Error(`${path} has ${bytes} bytes, the limit is ${MAX_PICTURE_BYTES}`);
  }
  console.log(path);
}

/** Hides parts of the page. */
async function hide(page, selector) {
  await page.evaluate((parts) => {
    for (const element of document.querySelectorAll(parts)) {
      element.style.visibility = "hidden";
    }
  }, selector);
}

/** Hides the readings: they are those of a browser that draws in software. */
function hideReadings(page) {
  return hide(page, "aside, footer, #notice");
}

/** Waits until the force on the first tool has stayed the same for a second. */
async function steady(page) {
  let last = null;
  let since = Date.now();
  for (const start = since; Date.now() - start < LONGEST_WAIT_S * 1000; await page.waitForTimeout(100)) {
    const force = await page.evaluate(() => Math.hypot(...(window.tensormass.state().tools[0]?.forceN ?? [0])));
    if (last === null || Math.abs(force - last) > STEADY_N || force < LEAST_FORCE_N) {
      last = force;
      since = Date.now();
    } else if (Date.now() - since > 1000) {
      return;
    }
  }
  throw new Error(`no steady force above ${LEAST_FORCE_N} N within ${LONGEST_WAIT_S} s`);
}

async function takeHand(name) {
  await withScene(name, async (url) => {
    const page = await open(url, WIDE);
    await steady(page);
    await hideReadings(page);
    await save(page, name);
  });
}

/** The groove of the scene `burn`, after its hand drew back. */
async function takeBurn() {
  await withScene("burn", async (url) => {
    const page = await open(url, WIDE);
    await hideReadings(page);
    // From above, and nearer.
    await page.mouse.move(480, 340);
    await page.mouse.down();
    await page.mouse.move(480, 460, { steps: 4 });
    await page.mouse.up();
    for (let turn = 0; turn < 4; turn += 1) {
      await page.mouse.wheel(0, -120);
    }
    const drewBack = ([step, x]) => {
      const state = window.tensormass.state();
      return state.step >= step && state.tools[0]?.positionM[0] < x;
    };
    await page.waitForFunction(drewBack, [BURNT_STEP, DRAWN_BACK_M], { polling: POLLING_MS });
    await save(page, "burn");
  });
}

/** The incision of the scene `cut`, and the force on the scalpel in it. */
async function takeCut() {
  await withScene("cut", async (url) => {
    const page = await open(url, WIDE);
    await hideReadings(page);
    await page.mouse.move(480, 340);
    await page.mouse.down();
    await page.mouse.move(440, 440, { steps: 4 });
    await page.mouse.up();
    for (let turn = 0; turn < 8; turn += 1) {
      await page.mouse.wheel(0, -120);
    }
    await page.waitForFunction((step) => window.tensormass.state().step >= step, CUT_STEP, { polling: POLLING_MS });
    await save(page, "cut");
  });
}

/** The piece that the scissors of `snip` took off, on the floor below the lobe. */
async function takeSnip() {
  await withScene("snip", async (url) => {
    const page = await open(url, WIDE);
    await hideReadings(page);
    await page.waitForFunction((step) => window.tensormass.state().step >= step, SNIPPED_STEP, { polling: POLLING_MS });
    await save(page, "snip");
  });
}

/** The piece that the scissors of `resect` took off, on the tray. */
async function takeResect() {
  await withScene("resect", async (url) => {
    const page = await open(url, WIDE);
    await hideReadings(page);
    await page.waitForFunction((step) => window.tensormass.state().step >= step, PUT_DOWN_STEP, { polling: POLLING_MS });
    await save(page, "resect");
  });
}

/** The picture of the README, at high quality, while the simulated device presses the organ. */
/** The scene of examples/textured_skin.py. */
async function takeTextured() {
  await withCommand(["run", "demo", "--backend", "cpu", "--no-fit"], /control (\S+)[^]*viewer: (\S+)/, async (control, url) => {
    const example = spawn(join(ROOT, ".venv", "bin", "python"), [join(ROOT, "examples", "textured_skin.py"), control]);
    await new Promise((resolve) => example.once("exit", resolve));
    const page = await open(`${url}&scene=textured`, WIDE, {}, "high");
    await page.waitForFunction(() => window.tensormass.state().drawn > 5);
    await hideReadings(page);
    await save(page, "textured");
  });
}

async function takeDemo() {
  await withScene("demo", async (url) => {
    const page = await open(url, ROOMY, {}, "high");
    await page.waitForFunction((least) => Math.hypot(...(window.tensormass.state().tools[0]?.forceN ?? [0])) > least, PRESSED_N);
    await page.evaluate(() => (document.querySelector("aside").style.visibility = "hidden"));
    await save(page, "viewer");
  });
}

/** The scene `dissect` when its hook is in the strands for the second time. */
async function takeDissect() {
  await withScene("dissect", async (url) => {
    const page = await open(url, WIDE);
    await page.waitForFunction(([x, y]) => {
      const at = window.tensormass.state().tools[0]?.positionM;
      return at !== undefined && at[0] < x && at[1] > y;
    }, SECOND_PASS_M);
    await hideReadings(page);
    await save(page, "dissect");
  });
}

/** Scenes in a grid. The hand of the first one holds tissue, the others stand. */
async function takeGrid() {
  await withScene(TILES[0], async (url) => {
    const page = await open(`${url}&scene=${TILES[0]}&grid=1`, ROOMY, { readings: false, plots: false });
    for (const name of TILES.slice(1)) {
      await page.locator("#scenes > summary").click();
      await page.locator("#builtin").selectOption(name);
      await page.locator("#load").click();
      await page.locator(".tile").filter({ hasText: name }).filter({ hasText: "Live" }).waitFor();
    }
    await page.locator(".tile").filter({ hasText: TILES[0] }).click();
    await page.mouse.move(0, 0);
    await steady(page);
    await page.waitForFunction(() => window.tensormass.tiles().every(({ drawn }) => drawn > 0));
    // Four scenes at once on the machine that also draws them reach rates that nobody else sees.
    await page.evaluate(() => (document.querySelector("aside").style.visibility = "hidden"));
    await save(page, "viewer-grid");
  });
}

/** One picture for each state of the page. */
async function takeViewer() {
  await withScene("retract", async (url) => {
    const empty = await open(`${url}&scene=kidney`, WIDE);
    await says(empty, "#notice", "no scene");
    await empty.locator("#scenes > summary").click();
    await save(empty, "viewer-empty");

    // Without help this beam inverts, and its guard stops it.
    const stopped = await open(`${url}&scene=beam`, WIDE, { readings: false });
    await says(stopped, "#notice", "no scene");
    await stopped.locator("#scenes > summary").click();
    await stopped.locator("#builtin").selectOption("beam");
    await stopped.locator("#load").click();
    await says(stopped, "#notice", "Scene stopped");
    await says(stopped, "#display > summary", "Display");
    await save(stopped, "viewer-error");

    const shown = `${url}&scene=retract`;
    const colours = { colouring: "displacement", rulers: true, readings: false, plots: true };
    const coloured = await open(shown, ROOMY, colours);
    await says(coloured, ".legend-title", "from rest");
    await steady(coloured);
    await coloured.locator("#display > summary").click();
    await save(coloured, "viewer-coloured");

    const clipped = await open(shown, WIDE, { colouring: "von_mises", clipAxis: "x", clipShare: 0.6, readings: false });
    await says(clipped, ".legend-title", "Von Mises");
    await steady(clipped);
    await save(clipped, "viewer-clip");

    const phone = await open(shown, PHONE);
    await steady(phone);
    await save(phone, "viewer-phone");

    const material = await open(shown, WIDE, { readings: false });
    await steady(material);
    await material.locator("#material > summary").click();
    await says(material, "#material-sliders output", "×");
    await save(material, "viewer-material");

    const paused = await open(shown, WIDE, { readings: false });
    await steady(paused);
    await paused.locator("#pause").click();
    await says(paused, "#link", "Paused");
    await save(paused, "viewer-paused");
  });
}

/** A recording, paused in its middle. */
async function takeTimeline() {
  const folder = mkdtempSync(join(tmpdir(), "tensormass-pictures-"));
  try {
    const file = join(folder, "retract.mcap");
    await recordHand("retract", file, RECORDED_S);
    await withCommand(["view", file], /viewer: (\S+)/, async (url) => {
      const page = await open(url, WIDE, { readings: false, plots: false });
      await says(page, "#link", "Paused");
      const handle = await page.locator("#seek").boundingBox();
      await page.mouse.click(handle.x + 0.5 * handle.width, handle.y + 0.5 * handle.height);
      await page.waitForFunction((least) => window.tensormass.state().step > least, 0.4 * 60 * RECORDED_S);
      await page.mouse.move(0, 0);
      await page.locator("output.force").waitFor();
      await save(page, "viewer-timeline");
    });
  } finally {
    rmSync(folder, { recursive: true, force: true });
  }
}

/** The probe on the demo's organ, as a film: press.py steps the scene, and each picture waits until its step is drawn. */
async function takeMoving() {
  const folder = mkdtempSync(join(tmpdir(), "tensormass-moving-"));
  const python = join(ROOT, ".venv", "bin", "python");
  const [pictures, every] = [String(MOVING.pictures), String(MOVING.everyS)];
  const args = [join(import.meta.dirname, "press.py"), "--pictures", pictures, "--every", every];
  const press = spawn(python, args, { stdio: ["pipe", "pipe", "inherit"] });
  const ended = new Promise((resolve) => press.once("exit", resolve));
  const lines = createInterface(press.stdout)[Symbol.asyncIterator]();
  try {
    const control = (await lines.next()).value.split(" ")[1];
    await withCommand(["view", "--server", control], /(http\S+)/, async (url) => {
      const page = await open(`${url}&scene=demo`, MOVING.size, { readings: false, plots: false }, QUALITY);
      await page.waitForFunction(() => window.tensormass.state().drawn > 0);
      await hide(page, "header, aside, footer, #bottom, #notice");
      for (let i = 0; i < MOVING.pictures; i += 1) {
        press.stdin.write("\n");
        const step = Number((await lines.next()).value);
        // A check at each turn of the browser would starve one that draws in software.
        const reached = (wanted) => window.tensormass.state().step >= wanted;
        await page.waitForFunction(reached, step, { polling: POLLING_MS });
        // Two more turns of the browser: the frame is then on the screen.
        await page.evaluate(() => new Promise((done) => window.requestAnimationFrame(() => window.requestAnimationFrame(done))));
        await page.screenshot({ path: join(folder, `${String(i).padStart(3, "0")}.png`), clip: MOVING.clip });
      }
      await page.context().close();
    });
    const out = join(ROOT, "docs", "images", "demo.webp");
    const film = spawn(python, [join(import.meta.dirname, "film.py"), "--every", every, "-o", out, folder], { stdio: "inherit" });
    if ((await new Promise((resolve) => film.once("exit", resolve))) !== 0) {
      throw new Error(`${out} was not made`);
    }
    console.log(out);
  } finally {
    press.stdin.end();
    await ended;
    rmSync(folder, { recursive: true, force: true });
  }
}

/** Pictures side by side. */
async function takeStrip() {
  const context = await browser.newContext({
    viewport: { width: STRIP.length * STRIP_PICTURE.width, height: STRIP_PICTURE.height },
  });
  context.setDefaultTimeout(LONGEST_WAIT_S * 1000);
  const page = await context.newPage();
  const pictures = STRIP.map((name) => {
    const data = readFileSync(join(ROOT, "docs", "images", `${name}.jpg`)).toString("base64");
    // Larger than its place, so that the page's head stays out.
    const picture = `<img src="data:image/jpeg;base64,${data}" width="600" style="margin: -44px 0 0 -60px">`;
    return `<div style="width: ${STRIP_PICTURE.width}px; overflow: hidden">${picture}</div>`;
  });
  await page.setContent(`<body style="margin: 0; display: flex">${pictures.join("")}</body>`);
  await save(page, "strip");
}

const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking"],
});
try {
  const wanted = process.argv.length > 2 ? process.argv.slice(2) : [...HANDS, ...Object.keys(PAGES)];
  for (const name of wanted) {
    await (PAGES[name]?.() ?? takeHand(name));
  }
} finally {
  await browser.close();
}
