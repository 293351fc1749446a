import { defineConfig } from "vite";

export default defineConfig({
  base: "./",
  oxc: { jsx: { runtime: "automatic", importSource: "preact" } },
  // Beside the code that serves it: the wheel takes it from there.
  build: { outDir: "../gonio/http/page", emptyOutDir: true, assetsInlineLimit: 0, chunkSizeWarningLimit: 900 },
  // `npm run dev` shows the page with the data of a running `gonio serve`.
  server: { proxy: { "/v1": "http://127.0.0.1:8000" } },
});
