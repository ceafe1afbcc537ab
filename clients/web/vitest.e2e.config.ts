// Runs the tests in tests/e2e with the modules of this folder: tests/e2e has none.
import { join } from "node:path";

import { defineConfig } from "vitest/config";

const root = join(import.meta.dirname, "..", "..");
const modules = join(import.meta.dirname, "node_modules");
const entries = {
  vitest: "dist/index.js",
  "playwright-core": "index.mjs",
  pngjs: "lib/png.js",
  "@mcap/core": "dist/esm/index.js",
  "@mcap/nodejs": "dist/cjs/src/index.js",
  "@mcap/support": "dist/esm/index.js",
};

export default defineConfig({
  root,
  resolve: {
    alias: Object.entries(entries).map(([name, entry]) => ({
      find: new RegExp(`^${name}$`),
      replacement: join(modules, name, entry),
    })),
  },
  server: { fs: { allow: [root] } },
  test: {
    include: ["tests/e2e/**/*.test.ts"],
    // Bounds against hanging only: a software renderer beside other work may take long.
    testTimeout: 120_000,
    hookTimeout: 120_000,
    expect: { poll: { timeout: 60_000 } },
    // tests/run.sh names each test that passed only at its second attempt.
    retry: 2,
    // One daemon and one software renderer already use two cores.
    fileParallelism: false,
  },
});
