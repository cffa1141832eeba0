// Draws views of a volume with WebGL 2: a fragment for each ray, over tables in textures.
import { Frames } from "../drawing/frames";
import { type Look, Lost, type Renderer, type Rows } from "../drawing/renderer";
import { channelsOf, ROWS, type Table, type TableName, type Tables, tablesOf } from "../drawing/tables";
import type { View } from "../drawing/view";
import type { Volume } from "../volume/payload";
import { copyProgram, TABLES, traceProgram } from "./program";
import { WebGlTarget } from "./target";

/** Rejected with a sentence where there is no WebGL 2, or it cannot draw the volume. */
export async function openWebGl(volume: Volume): Promise<Renderer> {
  const canvas = document.createElement("canvas");
  const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, depth: false });
  if (!gl) throw new Error("This browser has no WebGL 2, or it is switched off; this picture is all it can show.");
  return new WebGlRenderer(gl, canvas, volume);
}

class WebGlRenderer implements Renderer {
  readonly name = "WebGL 2";
  readonly lost: Promise<string>;
  private readonly program: WebGLProgram;
  private readonly copying: WebGLProgram;
  private readonly block: WebGLBuffer;
  private readonly textures = new Map<TableName, { texture: WebGLTexture; height: number }>();
  private readonly widthBits: number;
  private readonly frames: Frames;

  constructor(
    private readonly gl: WebGL2RenderingContext,
    readonly canvas: HTMLCanvasElement,
    volume: Volume,
  ) {
    this.widthBits = gl.getParameter(gl.MAX_TEXTURE_SIZE) >= 4096 ? 12 : 11;
    this.program = traceProgram(gl, volume.header, this.widthBits);
    this.copying = copyProgram(gl);
    this.block = gl.createBuffer()!;
    const tables = tablesOf(volume);
    this.frames = new Frames(volume, tables);
    this.fill(tables);
    this.lost = new Promise((resolve) => {
      canvas.addEventListener("webglcontextlost", () => {
        resolve("The graphics driver has given up on this page; load it again, with another quality.");
      });
    });
  }

  target(width: number, height: number): WebGlTarget {
    return new WebGlTarget(this.gl, width, height);
  }

  draw(target: WebGlTarget, view: View, look: Look, rows: Rows): void {
    const { gl } = this;
    const { block, tables } = this.frames.next(view, look, rows);
    this.fill(tables);
    gl.useProgram(this.program);
    gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, this.block);
    gl.bufferData(gl.UNIFORM_BUFFER, block, gl.DYNAMIC_DRAW);
    TABLES.forEach((name, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, this.textures.get(name)?.texture ?? null);
    });
    gl.activeTexture(gl.TEXTURE0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.viewport(0, 0, view.width, view.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, view.height - rows.last, view.width, rows.last - rows.first);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
  }

  present(target: WebGlTarget): void {
    const { gl } = this;
    gl.useProgram(this.copying);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.bindTexture(gl.TEXTURE_2D, target.color);
    gl.uniform2f(gl.getUniformLocation(this.copying, "size"), gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindTexture(gl.TEXTURE_2D, null);
  }

  finished(): Promise<void> {
    const { gl } = this;
    const sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0)!;
    gl.flush();
    return new Promise((resolve, reject) => {
      const look = () => {
        if (gl.isContextLost()) return reject(new Lost());
        if (gl.getSyncParameter(sync, gl.SYNC_STATUS) !== gl.SIGNALED) return requestAnimationFrame(look);
        gl.deleteSync(sync);
        resolve();
      };
      requestAnimationFrame(look);
    });
  }

  private fill(tables: Tables): void {
    for (const [name, values] of Object.entries(tables)) this.fillTable(name as TableName, values);
  }

  /** Puts the rows of a table one after the other into the rows of a texture. */
  private fillTable(name: TableName, values: Table): void {
    const { gl } = this;
    const channels = channelsOf(name);
    const width = 2 ** this.widthBits;
    const texels = values.length / channels;
    const height = Math.max(1, Math.ceil(texels / width));
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw new Error("This browser's textures are too small for a volume of so many cells; open it on another machine.");
    }
    const [format, layout, type] = {
      vec4f: [gl.RGBA32F, gl.RGBA, gl.FLOAT],
      vec2u: [gl.RG32UI, gl.RG_INTEGER, gl.UNSIGNED_INT],
      vec4u: [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT],
    }[ROWS[name]];
    gl.bindTexture(gl.TEXTURE_2D, this.textureOf(name, format, width, height));
    const full = Math.floor(texels / width);
    const rest = values.subarray(full * width * channels);
    if (full) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, full, layout, type, values, 0);
    if (rest.length) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, full, rest.length / channels, 1, layout, type, rest, 0);
  }

  private textureOf(name: TableName, format: number, width: number, height: number): WebGLTexture {
    const { gl } = this;
    const known = this.textures.get(name);
    if (known && known.height >= height) return known.texture;
    if (known) gl.deleteTexture(known.texture);
    const texture = gl.createTexture()!;
    this.textures.set(name, { texture, height });
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    }
    return texture;
  }
}
