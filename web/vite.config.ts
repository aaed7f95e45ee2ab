// Builds the viewer into dist/, which the server embeds; paths are relative, so it works under any prefix.
import { defineConfig } from "vitest/config";

export default defineConfig({
  base: "./",
  build: { target: "es2022", outDir: "dist", emptyOutDir: true, chunkSizeWarningLimit: 900 },
  server: {
    // `npx vite` for development: everything but the page itself comes from a running kesi.
    proxy: { "/v1": { target: process.env["KESI_URL"] ?? "http://127.0.0.1:8080", ws: true, changeOrigin: true, rewriteWsOrigin: true } },
  },
  test: { include: ["tests/**/*.test.ts"] },
});
