import { defineConfig } from "vitest/config";

export default defineConfig({
  base: "./",
  build: {
    target: "es2022",
    // three.js alone is above Vite's default of 500 kB.
    chunkSizeWarningLimit: 900,
  },
  test: {
    include: ["test/**/*.test.ts"],
  },
});
