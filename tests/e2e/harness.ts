// Surroundings of the browser's test: the stack under test as a child process, Chromium, and pictures to compare.
import { spawn, type ChildProcessWithoutNullStreams } from "node:child_process";
import { existsSync, mkdtempSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { createInterface } from "node:readline";

import { chromium, type BrowserContext, type Page } from "playwright-core";
import { PNG } from "pngjs";
import { expect } from "vitest";

const ROOT = join(import.meta.dirname, "..", "..");
const CHROMIUM = process.env.CHROMIUM ?? "/usr/bin/chromium";
const PYTHON = process.env.PYTHON ?? join(ROOT, ".venv", "bin", "python");
const DAEMON = process.env.TENSORMASSD ?? join(ROOT, "build", "bin", "tensormassd");

/** Says what is missing to run the test; empty if nothing is. */
export function missing(): string[] {
  return [CHROMIUM, PYTHON, DAEMON, join(ROOT, "clients", "web", "dist", "index.html")].filter((path) => !existsSync(path));
}

/** stack.py as a child process: a daemon, its scenes and the gateway. */
export class Stack {
  readonly #process: ChildProcessWithoutNullStreams;
  readonly #lines: AsyncIterator<string>;
  #errors = "";

  private constructor() {
    const viewer = join(ROOT, "clients", "web", "dist");
    this.#process = spawn(PYTHON, [join(ROOT, "tests", "e2e", "stack.py"), viewer]);
    this.#process.stderr.on("data", (chunk: Buffer) => (this.#errors += chunk.toString()));
    this.#lines = createInterface(this.#process.stdout)[Symbol.asyncIterator]();
  }

  /** The stack and the addresses of its viewer: for operators, and to look only. */
  static async start(): Promise<{ stack: Stack; url: string; lookUrl: string }> {
    const stack = new Stack();
    const { url, look_url } = (await stack.#answer()) as { url: string; look_url: string };
    return { stack, url, lookUrl: look_url };
  }

  /** Calls a method of stack.py's Stack. */
  async ask(what: string, args: Record<string, unknown> = {}): Promise<unknown> {
    this.#process.stdin.write(`${JSON.stringify({ do: what, ...args })}\n`);
    const reply = (await this.#answer()) as { result?: unknown; error?: string };
    if (reply.error !== undefined) {
      throw new Error(`${what}: ${reply.error}`);
    }
    return reply.result;
  }

  async stop(): Promise<void> {
    if (this.#process.exitCode === null) {
      const ended = new Promise((resolve) => this.#process.once("exit", resolve));
      this.#process.stdin.end();
      await ended;
    }
  }

  async #answer(): Promise<unknown> {
    const line = await this.#lines.next();
    if (line.done === true) {
      throw new Error(`stack.py ended:\n${this.#errors}`);
    }
    return JSON.parse(line.value);
  }
}

/** Records a scene in real time for some seconds, with frames. Returns the recording. */
export async function record(scene: string, folder: string, seconds: number): Promise<string> {
  const [sceneFile, recording] = [join(folder, "scene.yaml"), join(folder, "scene.mcap")];
  writeFileSync(sceneFile, scene);
  const options = ["--frames", "--backend", "cpu", "--seconds", String(seconds)];
  const child = spawn(PYTHON, ["-m", "tensormass", "record", sceneFile, "-o", recording, ...options], { stdio: ["ignore", "ignore", "pipe"] });
  let errors = "";
  child.stderr.on("data", (chunk: Buffer) => (errors += chunk.toString()));
  const status = await new Promise((resolve) => child.once("exit", resolve));
  if (status !== 0) {
    throw new Error(`tensormass record ended with ${String(status)}:\n${errors}`);
  }
  return recording;
}

/** `tensormass view RECORDING` as a child process, and the addresses of its viewer. */
export class RecordingView {
  private constructor(
    readonly url: string,
    readonly lookUrl: string,
    readonly stop: () => Promise<void>,
  ) {}

  static async start(recording: string): Promise<RecordingView> {
    const viewer = join(ROOT, "clients", "web", "dist");
    const child = spawn(PYTHON, ["-m", "tensormass", "view", recording, "--viewer", viewer, "--json"]);
    let errors = "";
    child.stderr.on("data", (chunk: Buffer) => (errors += chunk.toString()));
    const ended = new Promise((resolve) => child.once("exit", resolve));
    const line = await createInterface(child.stdout)[Symbol.asyncIterator]().next();
    if (line.done === true) {
      throw new Error(`tensormass view ended:\n${errors}`);
    }
    const { url, look_url } = JSON.parse(line.value) as { url: string; look_url: string };
    return new RecordingView(url, look_url, async () => {
      child.kill("SIGINT");
      await ended;
    });
  }
}

/** A new Chromium that draws in software. */
export class Browser {
  readonly #profile = mkdtempSync(join(tmpdir(), "tensormass-chromium-"));
  readonly #pages: ViewerPage[] = [];
  #context: BrowserContext | null = null;

  /** @param turnMs Time between two turns of the drawing loop by the page's clock; null: as they come. */
  async open(url: string, turnMs: number | null = null): Promise<ViewerPage> {
    this.#context ??= await chromium.launchPersistentContext(this.#profile, {
      executablePath: CHROMIUM,
      headless: true,
      viewport: { width: 960, height: 640 },
      args: [
        "--headless=new",
        "--no-sandbox",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--no-first-run",
        "--disable-quic",
      ],
    });
    // The limit of each test holds. A second one would only fail earlier on a busy machine.
    this.#context.setDefaultTimeout(0);
    const page = await this.#context.newPage();
    const viewer = new ViewerPage(page);
    this.#pages.push(viewer);
    if (turnMs !== null) {
      await page.addInitScript(setTurns, turnMs);
    }
    await page.goto(url);
    return viewer;
  }

  /**
   * Ends a test: closes all pages with what they remember. Returns the errors that their scripts threw.
   * @param failed Whether the test failed. Then what the pages say goes to the log: a wait that never ends has no reason.
   */
  async closePages(failed: boolean): Promise<string[]> {
    const pages = this.#pages.splice(0);
    for (const viewer of pages.filter(({ page }) => !page.isClosed())) {
      if (failed) {
        console.warn(`page of the test that failed: ${await viewer.sayings()}`);
      }
      await viewer.page.evaluate(() => window.localStorage.clear());
      await viewer.page.close();
    }
    return pages.flatMap(({ errors }) => errors);
  }

  async close(): Promise<void> {
    await this.#context?.close();
    rmSync(this.#profile, { recursive: true, force: true });
  }
}

/**
 * In the page: makes a machine of a given speed of this one. What it draws takes as long as before. All callbacks of a
 * turn get one time, as from the browser: else whatever else asks for turns, such as a wait of the test, would make the
 * machine slower.
 */
function setTurns(turnMs: number): void {
  const request = window.requestAnimationFrame.bind(window);
  let turn: number | null = null;
  let nowMs = 0;
  window.requestAnimationFrame = (callback) =>
    request((browserMs) => {
      if (browserMs !== turn) {
        turn = browserMs;
        nowMs += turnMs;
      }
      callback(nowMs);
    });
}

/** Ends a test: closes its pages, and unloads the scenes of one that failed. Fails if a page threw an exception. */
export async function endTest(browser: Browser, stack: Stack, failed: boolean): Promise<void> {
  const errors = await browser.closePages(failed);
  // What a test that failed has left would make those after it fail, too.
  if (failed) {
    await stack.ask("unload_all", {});
  }
  expect(errors).toEqual([]);
}

/** The interface of main.ts for scripts. */
export interface ViewerState {
  readonly topologyVersion: string | null;
  readonly scene: string | null;
  readonly vertexCount: number;
  /** Step of the newest frame; null before the first. */
  readonly step: number | null;
  readonly tools: readonly { readonly name: string; readonly positionM: readonly [number, number, number]; readonly orientationWxyz: readonly number[] }[];
  /** Springs of attachments that are drawn. */
  readonly strands: number;
  readonly drawn: number;
  readonly refused: number;
  readonly lastRefusal: string | null;
}

declare global {
  interface Window {
    tensormass: {
      /** The selected scene. */
      state(): ViewerState;
      /** All tiles, in their order on the page. */
      tiles(): ViewerState[];
      project(point: readonly number[]): { x: number; y: number } | null;
    };
  }
}

/** The page under test. */
export class ViewerPage {
  /** Errors thrown by the page's scripts. */
  readonly errors: string[] = [];

  constructor(readonly page: Page) {
    page.on("pageerror", (error) => this.errors.push(error.message));
  }

  state(): Promise<ViewerState> {
    return this.page.evaluate(() => window.tensormass.state());
  }

  project(point: readonly number[]): Promise<{ x: number; y: number } | null> {
    return this.page.evaluate((at) => window.tensormass.project(at), point);
  }

  /** Waits until the topology on show has this many vertices and a frame of it is drawn. */
  async shows(vertexCount: number): Promise<void> {
    await this.page.waitForFunction(
      (count) => {
        const state = window.tensormass.state();
        return state.vertexCount === count && state.drawn > 0;
      },
      vertexCount,
    );
  }

  /** Waits until there is a tile for each of these scenes, in this order, with a frame drawn. */
  async showsTiles(...scenes: string[]): Promise<void> {
    await this.page.waitForFunction((wanted) => {
      const tiles = window.tensormass.tiles();
      return tiles.every(({ drawn }) => drawn > 0) && tiles.map(({ scene }) => scene).join() === wanted;
    }, scenes.join());
  }

  /** Waits until `count` more frames have been drawn. */
  async draws(count: number): Promise<void> {
    const { drawn } = await this.state();
    await this.page.waitForFunction((until) => window.tensormass.state().drawn >= until, drawn + count);
  }

  /** Waits until the page draws at this level of quality. */
  async drawsAt(level: string): Promise<void> {
    await this.page.waitForFunction((name) => document.documentElement.dataset.quality === name, level);
  }

  /** Drags from one point of the page to another. */
  async drag(from: { x: number; y: number }, to: { x: number; y: number }): Promise<void> {
    await this.page.mouse.move(from.x, from.y);
    await this.page.mouse.down();
    await this.page.mouse.move(to.x, to.y, { steps: 4 });
    await this.page.mouse.up();
  }

  async says(selector: string, text: RegExp): Promise<void> {
    await this.page.locator(selector).filter({ hasText: text, visible: true }).waitFor();
  }

  /** Everything that the page says, in one line. */
  async sayings(): Promise<string> {
    const said = await this.page.evaluate(() => ({
      text: document.body.innerText.replaceAll(/\s+/g, " ").slice(0, 300),
      quality: document.documentElement.dataset.quality,
      state: "tensormass" in window ? window.tensormass.state() : null,
    }));
    return JSON.stringify(said);
  }

  /** The picture without the readings. */
  async picture(): Promise<PNG> {
    await this.#setReadings("hidden");
    const png = await this.page.screenshot();
    await this.#setReadings("");
    return PNG.sync.read(png);
  }

  // Hides elements one by one: the page's content policy forbids the style sheet that a screenshot could inject.
  #setReadings(visibility: string): Promise<void> {
    return this.page.evaluate(async (value) => {
      for (const element of document.querySelectorAll<HTMLElement>("header, aside, footer, #timeline, .labels, .caption, .scales, #notice, #toast")) {
        element.style.visibility = value;
      }
      await new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve)));
    }, visibility);
  }

  close(): Promise<void> {
    return this.page.close();
  }
}

/** Mean absolute difference of two pictures [0, 255] over the pixels for which `inside` is true. */
export function difference(a: PNG, b: PNG, inside: (x: number, y: number) => boolean): number {
  if (a.width !== b.width || a.height !== b.height) {
    throw new Error(`pictures of ${a.width}x${a.height} and ${b.width}x${b.height} pixels cannot be compared`);
  }
  let sum = 0;
  let count = 0;
  for (let y = 0; y < a.height; y += 1) {
    for (let x = 0; x < a.width; x += 1) {
      if (inside(x, y)) {
        const at = 4 * (y * a.width + x);
        for (let channel = 0; channel < 3; channel += 1) {
          sum += Math.abs(a.data[at + channel]! - b.data[at + channel]!);
        }
        count += 3;
      }
    }
  }
  if (count === 0) {
    throw new Error("no pixel lies inside");
  }
  return sum / count;
}
