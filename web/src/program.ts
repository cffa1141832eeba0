// Programs of the shaders, with the constants that a page has.
import type { Header, Optics } from "./payload";
import opticsSource from "./optics.glsl";
import transferSource from "./transfer.glsl";
import walkSource from "./walk.glsl";

const VERTEX = `#version 300 es
void main() {
  // One triangle that covers the screen.
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

const COPY = `#version 300 es
precision highp float;
uniform sampler2D source;
uniform vec2 size;
out vec4 pixel;
void main() { pixel = vec4(texture(source, gl_FragCoord.xy / size).rgb, 1.0); }`;

/** Shows the picture of texture unit 0, enlarged or made smaller. */
export function copyProgram(gl: WebGL2RenderingContext): WebGLProgram {
  return programOf(gl, VERTEX, COPY);
}

/** @param widthBits Binary logarithm of the width of textures that hold tables. */
export function walkProgram(gl: WebGL2RenderingContext, header: Header, widthBits: number): WebGLProgram {
  const cells = header.location === "cell";
  const scalars = header.kind === "scalar";
  const flags = [cells ? "CELLS" : scalars ? "" : "VERTEX_COLORS", scalars ? "SCALARS" : ""].filter(Boolean);
  const source = [
    "#version 300 es",
    ...flags.map((flag) => `#define ${flag}`),
    `#define WIDTH_BITS ${widthBits}u`,
    `#define WIDTH_MASK ${2 ** widthBits - 1}u`,
    "precision highp float;",
    constantsOf(header.optics),
    opticsSource,
    scalars ? "precision highp sampler2D;\n" + transferSource : "",
    walkSource,
  ].join("\n");
  return programOf(gl, VERTEX, source);
}

function constantsOf(optics: Optics): string {
  const array = (values: number[]) => `float[](${values.map(literal).join(", ")})`;
  return [
    `const float THIN = ${literal(optics.thin)}, VISIBLE = ${literal(optics.visible)};`,
    `const int NODE_COUNT = ${optics.nodes.length};`,
    `const float NODES[NODE_COUNT] = ${array(optics.nodes)};`,
    `const float WEIGHTS[NODE_COUNT] = ${array(optics.weights)};`,
    `float H_OF(float x) { return ${horner(optics.h.map(literal), "x")}; }`,
    `float SINH_OF(float x) { return ${horner(optics.sinh.map(literal), "x")}; }`,
    `float P_OF(float x) { return ${horner(optics.p.map(literal), "x")}; }`,
    `float U_OF(float x, float y) { return ${horner(
      optics.u.map((row) => horner(row.map(literal), "x")),
      "y",
    )}; }`,
  ].join("\n");
}

function literal(value: number): string {
  const text = String(value);
  return /[.e]/.test(text) ? text : `${text}.0`;
}

function horner(coefficients: string[], variable: string): string {
  return coefficients.reduceRight((sum, coefficient) => `(${coefficient} + ${variable} * ${sum})`);
}

function programOf(gl: WebGL2RenderingContext, vertex: string, fragment: string): WebGLProgram {
  const program = gl.createProgram()!;
  for (const [kind, source] of [
    [gl.VERTEX_SHADER, vertex],
    [gl.FRAGMENT_SHADER, fragment],
  ] as const) {
    const shader = gl.createShader(kind)!;
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    gl.deleteShader(shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    const logs = (gl.getAttachedShaders(program) ?? []).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error(`The shaders of this page do not compile here: ${logs.join(" ")} ${gl.getProgramInfoLog(program)}`);
  }
  return program;
}
