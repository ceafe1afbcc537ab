// Measures what a frame costs the viewer in a headless Chromium that draws in software, by codec. Prints a line of JSON
// for each codec. tests/bench/streams.py --browser runs it:
//
//     node tests/bench/stream_browser.mjs PYTHON FILE CASE
//
// decode: message to positions. prepare: copy to the GPU's arrays, and normals. render: the calls to WebGL. frame: from
// one new frame on the screen to the next. upload: positions and normals of the surface to a buffer of WebGL, until the
// device has them.
import { spawn } from "node:child_process";
import { createRequire } from "node:module";
import { join } from "node:path";
import { createInterface } from "node:readline";

const ROOT = join(import.meta.dirname, "..", "..");
const { chromium } = createRequire(join(ROOT, "clients", "web", "package.json"))("playwright-core");
const CODECS = {
  float32: "codec=float32",
  q16: "codec=q16",
  delta: "codec=delta",
  meshopt: "codec=meshopt",
  "q16, normals": "codec=q16&normals=true",
  "q16, detail 0.25": "codec=q16&detail=0.25",
};
// The first frames are slower: they build the scene, and the compiler has not seen them yet.
const WARM_FRAMES = 3;
const FRAMES = 9;
const UPLOADS = 30;

const [python, recorded, name] = process.argv.slice(2);

function median(values) {
  return values.toSorted((a, b) => a - b)[Math.floor(values.length / 2)];
}

const rounded = (value) => Math.round(1000 * value) / 1000;

/** Median time until the device has `bytes` bytes more [ms], in the page. */
function measureUpload({ bytes, count }) {
  const gl = document.createElement("canvas").getContext("webgl2");
  const data = new Float32Array(bytes / 4).fill(1);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
  // Reading back the last value waits for the device.
  const last = new Float32Array(1);
  const timed = (work) => {
    const began = performance.now();
    work();
    gl.getBufferSubData(gl.ARRAY_BUFFER, bytes - 4, last);
    return performance.now() - began;
  };
  timed(() => undefined);
  const uploads = [];
  const waits = [];
  for (let i = 0; i < count; i += 1) {
    uploads.push(timed(() => gl.bufferSubData(gl.ARRAY_BUFFER, 0, data)));
    waits.push(timed(() => undefined));
  }
  const middle = (values) => values.sort((a, b) => a - b)[count / 2];
  return middle(uploads) - middle(waits);
}

async function measure(context, url, codec) {
  const page = await context.newPage();
  await page.goto(`${url}&quality=low&${CODECS[codec]}`);
  await page.waitForFunction((count) => window.tensormass.costs().length >= count, WARM_FRAMES + FRAMES);
  const [state, costs] = await page.evaluate(() => [window.tensormass.state(), window.tensormass.costs()]);
  const warm = costs.slice(WARM_FRAMES);
  const upload = await page.evaluate(measureUpload, { bytes: 24 * state.vertexCount, count: UPLOADS });
  await page.close();
  if (state.refused > 0) {
    throw new Error(`the page refused ${state.refused} messages: ${state.lastRefusal}`);
  }
  const of = (name) => rounded(median(warm.map((each) => each[name])));
  return {
    vertices: state.vertexCount,
    bytes_per_frame: of("bytes"),
    decode_ms_least: rounded(Math.min(...warm.map((each) => each.decodeMs))),
    decode_ms_median: of("decodeMs"),
    prepare_ms_least: rounded(Math.min(...warm.map((each) => each.prepareMs))),
    prepare_ms_median: of("prepareMs"),
    render_ms_median: of("renderMs"),
    upload_ms_median: rounded(upload),
    frame_ms_median: rounded(median(warm.slice(1).map((each, i) => each.atMs - warm[i].atMs))),
    frames: warm.length,
  };
}

const served = spawn(python, [join(ROOT, "tests", "bench", "streams.py"), "--serve", recorded], { stdio: ["pipe", "pipe", "inherit"] });
const ended = new Promise((resolve) => served.once("exit", resolve));
const line = await createInterface(served.stdout)[Symbol.asyncIterator]().next();
const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
});
try {
  const context = await browser.newContext({ viewport: { width: 960, height: 640 } });
  // A busy machine draws a frame in seconds.
  context.setDefaultTimeout(0);
  for (const codec of Object.keys(CODECS)) {
    const result = await measure(context, JSON.parse(line.value).url, codec);
    console.log(JSON.stringify({ case: `browser: ${name}, ${codec}`, ...result }));
  }
} finally {
  await browser.close();
  served.stdin.end();
  await ended;
}
