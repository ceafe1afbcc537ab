// The tests in tests/e2e, which have no node_modules of their own.
import { join } from "node:path";

import { defineConfig } from "vitest/config";

const root = join(import.meta.dirname, "..", "..");
const modules = join(import.meta.dirname, "node_modules");

export default defineConfig({
  root,
  resolve: {
    alias: ["vitest", "playwright-core", "pngjs"].map((name) => ({
      find: new RegExp(`^${name}$`),
      replacement: join(modules, name, { vitest: "dist/index.js", "playwright-core": "index.mjs", pngjs: "lib/png.js" }[name]!),
    })),
  },
  server: { fs: { allow: [root] } },
  test: {
    include: ["tests/e2e/**/*.test.ts"],
    testTimeout: 60_000,
    hookTimeout: 60_000,
    // One daemon and one software renderer fill two cores.
    fileParallelism: false,
  },
});
