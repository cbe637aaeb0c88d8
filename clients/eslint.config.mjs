import tseslint from "typescript-eslint";

export default tseslint.config(
  { ignores: ["**/dist", "**/src/gen", "typescript/examples"] },
  {
    files: ["*/src/**/*.ts"],
    extends: [tseslint.configs.recommendedTypeChecked],
    languageOptions: { parserOptions: { projectService: true } },
    rules: {
      // Event handlers begin things that end by themselves.
      "@typescript-eslint/no-misused-promises": ["error", { checksVoidReturn: false }],
    },
  },
  { files: ["*/test/*.mjs"], extends: [tseslint.configs.recommended] },
);
