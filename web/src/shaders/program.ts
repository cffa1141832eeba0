// The program that both renderers run for each ray, in WGSL: `traced` of walk.wgsl and all that it needs, but for the
// functions that read tables (see tables.ts) and the variable `frame`, which each of them declares in its own way.
import type { Header, Optics } from "../volume/payload";
import frameSource from "./frame.wgsl";
import opticsSource from "./optics.wgsl";
import transferSource from "./transfer.wgsl";
import walkSource from "./walk.wgsl";

export { frameSource };

/** For volumes as a page's header describes them. */
export function programOf({ location, kind, optics }: Header): string {
  const flags = { CELLS: location === "cell", SCALARS: kind === "scalar" };
  return [
    ...Object.entries(flags).map(([name, isSet]) => `const ${name}: bool = ${isSet};`),
    "const VERTEX_COLORS: bool = !CELLS && !SCALARS;",
    constantsOf(optics),
    opticsSource,
    transferSource,
    walkSource,
  ].join("\n");
}

function constantsOf({ thin, visible, h, sinh, p, u, nodes, weights }: Optics): string {
  const terms = nodes.map((node, k) => {
    const x = literal(node);
    return `${literal(weights[k])} * exp((curve * ${x} + slope) * ${x})`;
  });
  const rows = u.map((row) => horner(row.map(literal), "x"));
  return [
    `const THIN: f32 = ${literal(thin)};`,
    `const VISIBLE: f32 = ${literal(visible)};`,
    "// Integral of exp(slope x + curve x^2) from 0 to 1.",
    `fn quadrature(slope: f32, curve: f32) -> f32 { return ${terms.join(" + ")}; }`,
    `fn hOf(x: f32) -> f32 { return ${horner(h.map(literal), "x")}; }`,
    `fn sinhOf(x: f32) -> f32 { return ${horner(sinh.map(literal), "x")}; }`,
    `fn pOf(x: f32) -> f32 { return ${horner(p.map(literal), "x")}; }`,
    `fn uOf(x: f32, y: f32) -> f32 { return ${horner(rows, "y")}; }`,
  ].join("\n");
}

function literal(value: number): string {
  const text = String(value);
  return /[.e]/.test(text) ? text : `${text}.0`;
}

function horner(coefficients: string[], variable: string): string {
  return coefficients.reduceRight((sum, coefficient) => `(${coefficient} + ${variable} * ${sum})`);
}
