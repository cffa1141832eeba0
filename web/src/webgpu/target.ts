// Pictures on WebGPU's side: colours in a texture, records of rays in a buffer.
import { Lost, type Target } from "../drawing/renderer";
import { PIXEL_FORMAT, type Pipelines } from "./program";

const ROW_ALIGNMENT = 256; // bytes, of rows of a texture in a buffer

export class WebGpuTarget implements Target {
  /** What the compute shader writes. */
  readonly outputs: GPUBindGroup;
  /** What the canvas shows. */
  readonly shown: GPUBindGroup;
  private readonly color: GPUTexture;
  private readonly traces: GPUBuffer;

  constructor(
    private readonly device: GPUDevice,
    { trace, copy }: Pipelines,
    readonly width: number,
    readonly height: number,
  ) {
    this.color = device.createTexture({
      size: [width, height],
      format: PIXEL_FORMAT,
      usage: GPUTextureUsage.STORAGE_BINDING | GPUTextureUsage.TEXTURE_BINDING | GPUTextureUsage.COPY_SRC,
    });
    this.traces = device.createBuffer({
      size: 4 * width * height,
      usage: GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_SRC,
    });
    const view = this.color.createView();
    const sampler = device.createSampler({ magFilter: "linear", minFilter: "linear" });
    this.outputs = device.createBindGroup({
      layout: trace.getBindGroupLayout(1),
      entries: [
        { binding: 0, resource: view },
        { binding: 1, resource: { buffer: this.traces } },
      ],
    });
    this.shown = device.createBindGroup({
      layout: copy.getBindGroupLayout(0),
      entries: [
        { binding: 0, resource: view },
        { binding: 1, resource: sampler },
      ],
    });
  }

  async pixels(): Promise<Uint8Array<ArrayBuffer>> {
    const { width, height } = this;
    const bytesPerRow = Math.ceil((4 * width) / ROW_ALIGNMENT) * ROW_ALIGNMENT;
    const rows = await this.read(bytesPerRow * height, (encoder, buffer) => {
      encoder.copyTextureToBuffer({ texture: this.color }, { buffer, bytesPerRow }, [width, height]);
    });
    const pixels = new Uint8Array(4 * width * height);
    for (let row = 0; row < height; row++) {
      pixels.set(new Uint8Array(rows, bytesPerRow * row, 4 * width), 4 * width * row);
    }
    return pixels;
  }

  async records(): Promise<Uint32Array> {
    const { size } = this.traces;
    return new Uint32Array(
      await this.read(size, (encoder, buffer) => encoder.copyBufferToBuffer(this.traces, 0, buffer, 0, size)),
    );
  }

  delete(): void {
    this.color.destroy();
    this.traces.destroy();
  }

  /** What was copied to a buffer from which JavaScript can read. */
  private async read(
    size: number,
    copy: (encoder: GPUCommandEncoder, buffer: GPUBuffer) => void,
  ): Promise<ArrayBuffer> {
    const { device } = this;
    const buffer = device.createBuffer({ size, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST });
    const encoder = device.createCommandEncoder();
    copy(encoder, buffer);
    device.queue.submit([encoder.finish()]);
    try {
      await buffer.mapAsync(GPUMapMode.READ);
    } catch {
      device.destroy(); // if it is not lost already: a picture that cannot be read is of no use
      throw new Lost();
    }
    const content = buffer.getMappedRange().slice(0);
    buffer.destroy();
    return content;
  }
}
