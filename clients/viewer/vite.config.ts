import { defineConfig } from "vite";

// `npm run dev` serves the page with live reload, and asks a server that runs besides for everything else.
const server = process.env.PALPATE ?? "http://127.0.0.1:7117";

export default defineConfig({
  build: {
    target: "es2022",
    // three.js is most of it.
    chunkSizeWarningLimit: 1200,
    // A picture within the page would need another content security policy.
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    rolldownOptions: { input: ["index.html", "trainer.html"] },
  },
  server: { proxy: { "^/(palpate\\.v1\\.|textures/)": server } },
});
