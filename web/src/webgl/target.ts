// Pictures in textures of WebGL 2: colours, and records of rays.
import { Lost, type Target } from "../drawing/renderer";

export class WebGlTarget implements Target {
  readonly frame: WebGLFramebuffer;
  readonly color: WebGLTexture;
  private readonly traces: WebGLTexture;

  constructor(
    private readonly gl: WebGL2RenderingContext,
    readonly width: number,
    readonly height: number,
  ) {
    this.frame = gl.createFramebuffer()!;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    this.color = this.attached(0, gl.RGBA8, gl.LINEAR);
    this.traces = this.attached(1, gl.R32UI, gl.NEAREST);
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
  }

  async pixels(): Promise<Uint8Array<ArrayBuffer>> {
    const { gl, width, height } = this;
    const upsideDown = new Uint8Array(4 * width * height);
    this.read(gl.COLOR_ATTACHMENT0, gl.RGBA, gl.UNSIGNED_BYTE, upsideDown);
    const pixels = new Uint8Array(upsideDown.length);
    for (let row = 0; row < height; row++) {
      pixels.set(upsideDown.subarray(4 * width * row, 4 * width * (row + 1)), 4 * width * (height - 1 - row));
    }
    return pixels;
  }

  async records(): Promise<Uint32Array> {
    const { gl, width, height } = this;
    const records = new Uint32Array(width * height);
    this.read(gl.COLOR_ATTACHMENT1, gl.RED_INTEGER, gl.UNSIGNED_INT, records);
    return records;
  }

  delete(): void {
    this.gl.deleteTexture(this.color);
    this.gl.deleteTexture(this.traces);
    this.gl.deleteFramebuffer(this.frame);
  }

  private read(place: number, layout: number, type: number, values: Uint8Array | Uint32Array): void {
    const { gl, width, height } = this;
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.frame);
    gl.readBuffer(place);
    gl.readPixels(0, 0, width, height, layout, type, values);
    if (gl.isContextLost()) throw new Lost();
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
