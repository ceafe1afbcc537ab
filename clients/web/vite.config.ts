import { defineConfig } from "vitest/config";

export default defineConfig({
  base: "./",
  build: {
    target: "es2022",
    // three.js alone exceeds Vite's default limit of 500 kB.
    chunkSizeWarningLimit: 900,
  },
  test: {
    include: ["test/**/*.test.ts"],
    testTimeout: 60_000, // against hanging only
  },
});
