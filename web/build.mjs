// Bundles src/ into the script that difftetvr ships, and notes there what it was made of.
import { createHash } from "node:crypto";
import { readFileSync, readdirSync, statSync } from "node:fs";
import { sep } from "node:path";
import { build } from "esbuild";

const OUTPUT = "../src/difftetvr/view/page/page.js";

/** SHA-256 of the paths and contents of all sources, in the order of their paths. */
function hashOfSources() {
  const hash = createHash("sha256");
  const paths = readdirSync("src", { recursive: true }).map((path) => path.replaceAll(sep, "/"));
  for (const path of paths.filter((path) => statSync(`src/${path}`).isFile()).sort()) {
    hash.update(`${path}\n`);
    hash.update(readFileSync(`src/${path}`));
  }
  return hash.digest("hex");
}

await build({
  entryPoints: ["src/main.ts"],
  bundle: true,
  minify: true,
  charset: "ascii",
  format: "iife",
  target: "es2020",
  legalComments: "none",
  loader: { ".css": "text", ".wgsl": "text" },
  banner: { js: `/* Built from web/src by 'make page'; sources ${hashOfSources()} */` },
  outfile: OUTPUT,
});
console.log(`Wrote ${OUTPUT}`);
