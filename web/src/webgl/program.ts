// Programs of WebGL 2: a fragment shader for each ray, and one that shows a picture.
import { channelsOf, ROWS, type TableName } from "../drawing/tables";
import { GLSL_PRELUDE, glslOf } from "../shaders/glsl";
import { frameSource, programOf } from "../shaders/program";
import type { Header } from "../volume/payload";

export const TABLES = Object.keys(ROWS) as TableName[];

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

const PRECISIONS = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
`;

const MAIN = `
layout(location = 0) out vec4 pixel;
layout(location = 1) out uint record;
void main() {
  Traced ends = traced(vec2(gl_FragCoord.x, float(frame.height) - gl_FragCoord.y));
  pixel = vec4(ends.light.color + ends.light.transmittance * frame.background.xyz, 1.0);
  record = ends.record;
}`;

/** Shows the picture of texture unit 0, enlarged or made smaller. */
export function copyProgram(gl: WebGL2RenderingContext): WebGLProgram {
  return linked(gl, COPY);
}

/** Its textures are those of the units of TABLES; its block is that of binding point 0.
 *
 * @param widthBits Binary logarithm of the width of textures that hold tables.
 */
export function traceProgram(gl: WebGL2RenderingContext, header: Header, widthBits: number): WebGLProgram {
  const program = linked(
    gl,
    [
      PRECISIONS,
      ...TABLES.map((name) => tableSource(name, widthBits)),
      GLSL_PRELUDE,
      glslOf(frameSource),
      "layout(std140) uniform Block { Frame frame; };",
      glslOf(programOf(header)),
      MAIN,
    ].join("\n"),
  );
  gl.useProgram(program);
  TABLES.forEach((name, unit) => gl.uniform1i(gl.getUniformLocation(program, name), unit));
  gl.uniformBlockBinding(program, gl.getUniformBlockIndex(program, "Block"), 0);
  return program;
}

/** A texture, and the function that reads a row of the table that it holds. */
function tableSource(name: TableName, widthBits: number): string {
  const isWhole = ROWS[name].endsWith("u") ? "u" : "";
  const channels = channelsOf(name);
  const place = `ivec2(int(index & ${2 ** widthBits - 1}u), int(index >> ${widthBits}u))`;
  return `uniform ${isWhole}sampler2D ${name};
${isWhole}vec${channels} ${name}At(uint index) { return texelFetch(${name}, ${place}, 0).${"xyzw".slice(0, channels)}; }`;
}

function linked(gl: WebGL2RenderingContext, fragment: string): WebGLProgram {
  const program = gl.createProgram()!;
  for (const [kind, source] of [
    [gl.VERTEX_SHADER, VERTEX],
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
