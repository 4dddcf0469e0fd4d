// Bundles the dashboard's scripts and style into ../static: `npm ci --ignore-scripts && npm run build`.
// The output is committed, so that running the service needs no Node. `build.json` holds the digest of every
// source: a test compares it with the sources and so notices a bundle that was not rebuilt.

import { build } from "esbuild";
import { createHash } from "node:crypto";
import { copyFileSync, mkdirSync, readFileSync, readdirSync, rmSync, writeFileSync } from "node:fs";

const OUT = "../static";
const LICENCES = {
  "fflate.txt": "node_modules/fflate/LICENSE",
  "htmx.txt": "node_modules/htmx.org/LICENSE",
  "three.txt": "node_modules/three/LICENSE",
};

rmSync(OUT, { recursive: true, force: true });
mkdirSync(`${OUT}/licences`, { recursive: true });

await build({
  entryPoints: ["app.js", "cloud.js", "curve.js", "film.js", "first.js", "markers.js", "playground.js", "tracking.js", "upload.js", "style.css"].map((name) => `src/${name}`),
  outdir: OUT,
  bundle: true,
  minify: true,
  splitting: true, // three.js once for all that draw
  chunkNames: "[name]-[hash]",
  format: "esm",
  target: ["es2022"],
  legalComments: "eof",
  logLevel: "info",
});

for (const [name, source] of Object.entries(LICENCES)) copyFileSync(source, `${OUT}/licences/${name}`);
copyFileSync("src/favicon.svg", `${OUT}/favicon.svg`);

const PALETTE = "../../../physworld/report/palette.css";
const sources = ["build.mjs", "package.json", "package-lock.json", PALETTE, ...readdirSync("src").map((f) => `src/${f}`)];
const digests = Object.fromEntries(
  sources.sort().map((path) => [path, createHash("sha256").update(readFileSync(path)).digest("hex")]),
);
writeFileSync(`${OUT}/build.json`, JSON.stringify(digests, null, 1) + "\n");
