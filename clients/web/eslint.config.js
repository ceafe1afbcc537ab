import eslint from "@eslint/js";
import tseslint from "typescript-eslint";

// Paths are relative to the root of the repository, from which `npm run lint` starts eslint: tests/e2e is outside of
// this folder.
export default tseslint.config(
  { ignores: ["clients/web/dist", "clients/web/src/generated"] },
  eslint.configs.recommended,
  {
    files: ["**/*.ts"],
    extends: [tseslint.configs.strictTypeChecked],
    languageOptions: { parserOptions: { project: "./tsconfig.json", tsconfigRootDir: import.meta.dirname } },
    rules: {
      // A loop's bounds keep its index inside a typed array, so no branch is needed.
      "@typescript-eslint/no-non-null-assertion": "off",
      "@typescript-eslint/restrict-template-expressions": ["error", { allowNumber: true }],
      "@typescript-eslint/no-confusing-void-expression": ["error", { ignoreArrowShorthand: true }],
    },
  },
  {
    files: ["**/*.js", "**/*.mjs"],
    languageOptions: {
      globals: Object.fromEntries(
        // Node's, and the browser's: Playwright runs parts of these files in the page.
        ["console", "process", "setTimeout", "URL", "document", "performance", "window"].map((name) => [name, "readonly"]),
      ),
    },
  },
);
