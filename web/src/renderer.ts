// Draws views of a volume with WebGL2.
import { seenFrom } from "./harmonics";
import { hierarchyOf } from "./hierarchy";
import type { TransferKnots, Vector, Volume } from "./payload";
import { copyProgram, walkProgram } from "./program";
import { topologyOf } from "./topology";
import type { View } from "./view";

/** How a volume is drawn, whatever the view. */
export interface Look {
  background: Vector;
  /** a, b, c, d of the half-space a x + b y + c z + d >= 0 that is seen, in the page's units; null: everything. */
  clip: [number, number, number, number] | null;
  /** Factor of all densities. */
  density: number;
  /** Whether colours depend on the direction, where the volume has such. */
  directional: boolean;
}

/** What happened to the rays of a picture. */
export interface Audit {
  rays: number;
  /** Of one ray at most. */
  mostSteps: number;
  meanSteps: number;
  /** Rays for which no face of a cell was found to leave through; they went on through the nearest one. */
  lost: number;
  /** Rays that ended at the bound of steps. */
  bounded: number;
}

/** No ray takes more steps; what comes behind them is not seen. */
export const STEP_BOUND = 16384;

export class Target {
  readonly frame: WebGLFramebuffer;
  readonly color: WebGLTexture;
  private readonly records: WebGLTexture;

  constructor(
    private readonly gl: WebGL2RenderingContext,
    readonly width: number,
    readonly height: number,
  ) {
    this.frame = gl.createFramebuffer()!;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    this.color = this.attached(0, gl.RGBA8, gl.LINEAR);
    this.records = this.attached(1, gl.R32UI, gl.NEAREST);
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
  }

  /** (width height 4) bytes, from the top row on. */
  pixels(): Uint8Array {
    const { gl, width, height } = this;
    const upsideDown = new Uint8Array(4 * width * height);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.frame);
    gl.readBuffer(gl.COLOR_ATTACHMENT0);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, upsideDown);
    const pixels = new Uint8Array(upsideDown.length);
    for (let row = 0; row < height; row++) {
      pixels.set(upsideDown.subarray(4 * width * row, 4 * width * (row + 1)), 4 * width * (height - 1 - row));
    }
    return pixels;
  }

  audit(): Audit {
    const { gl, width, height } = this;
    const records = new Uint32Array(width * height);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.frame);
    gl.readBuffer(gl.COLOR_ATTACHMENT1);
    gl.readPixels(0, 0, width, height, gl.RED_INTEGER, gl.UNSIGNED_INT, records);
    gl.readBuffer(gl.COLOR_ATTACHMENT0);
    const audit: Audit = { rays: records.length, mostSteps: 0, meanSteps: 0, lost: 0, bounded: 0 };
    for (const record of records) {
      const steps = record & 0xffffff;
      audit.mostSteps = Math.max(audit.mostSteps, steps);
      audit.meanSteps += steps / records.length;
      audit.lost += (record >> 24) & 1;
      audit.bounded += (record >> 25) & 1;
    }
    return audit;
  }

  delete(): void {
    this.gl.deleteTexture(this.color);
    this.gl.deleteTexture(this.records);
    this.gl.deleteFramebuffer(this.frame);
  }

  private attached(place: number, format: number, filter: number): WebGLTexture {
    const { gl } = this;
    const texture = gl.createTexture()!;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, this.width, this.height);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, filter);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) {
      gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    }
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + place, gl.TEXTURE_2D, texture, 0);
    return texture;
  }
}

export class Renderer {
  private readonly program: WebGLProgram;
  private readonly copying: WebGLProgram;
  private readonly uniforms = new Map<string, WebGLUniformLocation | null>();
  private readonly textures = new Map<string, WebGLTexture>();
  private readonly widthBits: number;
  private readonly nodeCount: number;
  private readonly places: Float32Array | null;
  private readonly seen: Float32Array;
  private knotCount = 0;
  private seenBy = "";

  constructor(
    private readonly gl: WebGL2RenderingContext,
    private readonly volume: Volume,
  ) {
    const { header, positions, cells, odd, values } = volume;
    this.widthBits = gl.getParameter(gl.MAX_TEXTURE_SIZE) >= 4096 ? 12 : 11;
    this.program = walkProgram(gl, header, this.widthBits);
    this.copying = copyProgram(gl);
    const topology = topologyOf(cells, odd);
    const hierarchy = hierarchyOf(positions, topology.boundary);
    this.nodeCount = hierarchy.nodes.length / 8;
    const records = new Float32Array(4 * header.vertices);
    for (let i = 0; i < header.vertices; i++) {
      records.set(positions.subarray(3 * i, 3 * i + 3), 4 * i);
      if (header.location === "vertex") records[4 * i + 3] = values[4 * i + 3];
    }
    this.addTable("vertices", gl.RGBA32F, records, 4);
    this.addTable("links", gl.RG32UI, topology.links, 2);
    this.addTable("faces", gl.RGBA32UI, hierarchy.faces, 4);
    this.addTable("nodes", gl.RGBA32F, hierarchy.nodes, 4);
    this.places = volume.harmonics ? placesOf(volume) : null;
    this.seen = values.slice();
    const hasTable = header.kind === "color" || header.location === "cell";
    this.addTable("colors", gl.RGBA32F, hasTable ? this.seen : new Float32Array(4), 4);
    if (header.transfer) this.setTransfer(header.transfer);
  }

  /** Makes scalars look otherwise. */
  setTransfer(transfer: TransferKnots): void {
    const { gl } = this;
    const count = transfer.scalar.length;
    const texels = new Float32Array(8 * count);
    for (let k = 0; k < count; k++) {
      texels[4 * k] = transfer.scalar[k];
      texels.set([...transfer.color[k], transfer.opacity[k] * transfer.density], 4 * (count + k));
    }
    gl.bindTexture(gl.TEXTURE_2D, this.textureOf("knots"));
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, count, 2, 0, gl.RGBA, gl.FLOAT, texels);
    this.knotCount = count;
  }

  /** Draws rows of a view, counted from the bottom. */
  draw(target: Target, view: View, look: Look, first = 0, last = view.height): void {
    const { gl } = this;
    this.colorFor(view.eye, look.directional);
    gl.useProgram(this.program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.viewport(0, 0, view.width, view.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, first, view.width, last - first);
    let unit = 0;
    for (const [name, texture] of this.textures) {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(this.uniform(name), unit++);
    }
    gl.uniform3fv(this.uniform("eye"), view.eye);
    gl.uniformMatrix3fv(this.uniform("axes"), false, [...view.right, ...view.down, ...view.forward]);
    gl.uniform4fv(this.uniform("lens"), view.lens);
    gl.uniform1f(this.uniform("height"), view.height);
    gl.uniform4fv(this.uniform("clip"), look.clip ?? [0, 0, 0, 0]);
    gl.uniform3fv(this.uniform("background"), look.background);
    gl.uniform1f(this.uniform("densityScale"), look.density);
    gl.uniform1i(this.uniform("nodeCount"), this.nodeCount);
    gl.uniform1i(this.uniform("knotCount"), this.knotCount);
    gl.uniform1i(this.uniform("mostSteps"), STEP_BOUND);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
    gl.activeTexture(gl.TEXTURE0);
  }

  /** Shows a target on the canvas. */
  present(target: Target): void {
    const { gl } = this;
    gl.useProgram(this.copying);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.bindTexture(gl.TEXTURE_2D, target.color);
    gl.uniform2f(gl.getUniformLocation(this.copying, "size"), gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindTexture(gl.TEXTURE_2D, null);
  }

  private colorFor(eye: Vector, directional: boolean): void {
    const { harmonics, values } = this.volume;
    const key = directional ? eye.join() : "";
    if (!harmonics || !this.places || key === this.seenBy) return;
    if (directional) seenFrom(this.seen, values, this.places, harmonics.coefficients, harmonics.degree, eye);
    else this.seen.set(values);
    this.addTable("colors", this.gl.RGBA32F, this.seen, 4);
    this.seenBy = key;
  }

  private uniform(name: string): WebGLUniformLocation | null {
    if (!this.uniforms.has(name)) this.uniforms.set(name, this.gl.getUniformLocation(this.program, name));
    return this.uniforms.get(name)!;
  }

  private textureOf(name: string): WebGLTexture {
    const { gl } = this;
    const known = this.textures.get(name);
    if (known) return known;
    const texture = gl.createTexture()!;
    this.textures.set(name, texture);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    }
    return texture;
  }

  /** Puts a long array of texels into rows of a texture. */
  private addTable(name: string, format: number, values: Float32Array | Uint32Array, channels: number): void {
    const { gl } = this;
    const width = 2 ** this.widthBits;
    const texels = values.length / channels;
    const height = Math.max(1, Math.ceil(texels / width));
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw new Error("This browser's textures are too small for a volume of so many cells; open it on another machine.");
    }
    const layout = format === gl.RGBA32F ? gl.RGBA : channels === 2 ? gl.RG_INTEGER : gl.RGBA_INTEGER;
    const type = values instanceof Float32Array ? gl.FLOAT : gl.UNSIGNED_INT;
    const isNew = !this.textures.has(name);
    gl.bindTexture(gl.TEXTURE_2D, this.textureOf(name));
    if (isNew) gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
    const full = Math.floor(texels / width);
    const rest = values.subarray(full * width * channels);
    if (full) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, full, layout, type, values, 0);
    if (rest.length) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, full, rest.length / channels, 1, layout, type, rest, 0);
  }
}

/** (N, 3) places of vertices, or centres of cells, that colours are seen at. */
function placesOf(volume: Volume): Float32Array {
  const { header, positions, cells } = volume;
  if (header.location === "vertex") return positions;
  const centers = new Float32Array(3 * header.cells);
  cells.forEach((vertex, corner) => {
    for (let k = 0; k < 3; k++) centers[3 * (corner >> 2) + k] += positions[3 * vertex + k] / 4;
  });
  return centers;
}
