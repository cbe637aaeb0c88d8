import { defineConfig } from "vite";

export default defineConfig({
  build: { target: "es2022", rolldownOptions: { input: ["look.html", "touch.html", "front.html"].map((page) => `${import.meta.dirname}/${page}`) } },
});
