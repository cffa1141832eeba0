// Bundles src/ into the script that difftetvr ships, and notes there what it was made of.
import { createHash } from "node:crypto";
import { readFileSync, readdirSync } from "node:fs";
import { build } from "esbuild";

const OUTPUT = "../src/difftetvr/view/page/page.js";

/** SHA-256 of the names and contents of all sources, in the order of their names. */
function hashOfSources() {
  const hash = createHash("sha256");
  for (const name of readdirSync("src").sort()) {
    hash.update(`${name}\n`);
    hash.update(readFileSync(`src/${name}`));
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
  loader: { ".css": "text", ".glsl": "text" },
  banner: { js: `/* Built from web/src by 'make page'; sources ${hashOfSources()} */` },
  outfile: OUTPUT,
});
console.log(`Wrote ${OUTPUT}`);
