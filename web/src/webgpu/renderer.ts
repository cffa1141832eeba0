// Draws views of a volume with WebGPU: a thread of a compute shader for each ray, over tables in storage buffers.
import { FRAME_BYTES, Frames } from "../drawing/frames";
import { type Look, Lost, type Renderer, type Rows } from "../drawing/renderer";
import { ROWS, type Table, type TableName, type Tables, tablesOf } from "../drawing/tables";
import type { View } from "../drawing/view";
import type { Volume } from "../volume/payload";
import { adapterFor, checked, deviceFor } from "./device";
import { GROUP, type Pipelines, pipelinesOf } from "./program";
import { WebGpuTarget } from "./target";

/** Rejected with a sentence where there is no WebGPU, or it cannot draw the volume.
 *
 * @param takesAny Whether it may be one that computes on the CPU.
 */
export async function openWebGpu(volume: Volume, takesAny: boolean): Promise<Renderer> {
  const adapter = await adapterFor(takesAny);
  const tables = tablesOf(volume);
  const device = await deviceFor(adapter, [...Object.values(tables), volume.values]);
  try {
    return await checked(device, async () => {
      const pipelines = pipelinesOf(device, volume.header, navigator.gpu.getPreferredCanvasFormat());
      const buffers = new Buffers(device, tables);
      return new WebGpuRenderer(device, await pipelines, buffers, new Frames(volume, tables));
    });
  } catch (error) {
    device.destroy();
    throw error;
  }
}

/** The tables, and the block of a frame, as buffers. */
class Buffers {
  private readonly block: GPUBuffer;
  private readonly tables = new Map<TableName, GPUBuffer>();
  private group: GPUBindGroup | null = null;

  constructor(
    private readonly device: GPUDevice,
    tables: Tables,
  ) {
    this.block = this.bufferOf(FRAME_BYTES, GPUBufferUsage.UNIFORM);
    const nothing = new Float32Array(4);
    for (const name of Object.keys(ROWS) as TableName[]) this.fillTable(name, tables[name] ?? nothing);
  }

  fill(block: ArrayBuffer, tables: Tables): void {
    this.device.queue.writeBuffer(this.block, 0, block);
    for (const [name, values] of Object.entries(tables)) this.fillTable(name as TableName, values);
  }

  bound(layout: GPUBindGroupLayout): GPUBindGroup {
    const buffers = [this.block, ...this.tables.values()];
    const entries = buffers.map((buffer, binding) => ({ binding, resource: { buffer } }));
    return (this.group ??= this.device.createBindGroup({ layout, entries }));
  }

  private fillTable(name: TableName, values: Table): void {
    let buffer = this.tables.get(name);
    if (buffer?.size !== values.byteLength) {
      buffer?.destroy();
      buffer = this.bufferOf(values.byteLength, GPUBufferUsage.STORAGE);
      this.tables.set(name, buffer);
      this.group = null;
    }
    this.device.queue.writeBuffer(buffer, 0, values);
  }

  private bufferOf(size: number, usage: GPUBufferUsageFlags): GPUBuffer {
    return this.device.createBuffer({ size, usage: usage | GPUBufferUsage.COPY_DST });
  }
}

class WebGpuRenderer implements Renderer {
  readonly name = "WebGPU";
  readonly canvas = document.createElement("canvas");
  readonly lost: Promise<string>;
  private readonly context: GPUCanvasContext;

  constructor(
    private readonly device: GPUDevice,
    private readonly pipelines: Pipelines,
    private readonly buffers: Buffers,
    private readonly frames: Frames,
  ) {
    const context = this.canvas.getContext("webgpu");
    if (!context) throw new Error("WebGPU cannot draw on this page.");
    this.context = context;
    context.configure({ device, format: navigator.gpu.getPreferredCanvasFormat(), alphaMode: "opaque" });
    let failure = "";
    device.addEventListener("uncapturederror", ({ error }) => {
      failure ||= error.message;
      device.destroy(); // what it draws is wrong from now on
    });
    this.lost = device.lost.then(({ message }) => `WebGPU has failed: ${failure || message}`);
  }

  target(width: number, height: number): WebGpuTarget {
    return new WebGpuTarget(this.device, this.pipelines, width, height);
  }

  draw(target: WebGpuTarget, view: View, look: Look, rows: Rows): void {
    const { device, buffers, pipelines } = this;
    const { block, tables } = this.frames.next(view, look, rows);
    buffers.fill(block, tables);
    const encoder = device.createCommandEncoder();
    const pass = encoder.beginComputePass();
    pass.setPipeline(pipelines.trace);
    pass.setBindGroup(0, buffers.bound(pipelines.trace.getBindGroupLayout(0)));
    pass.setBindGroup(1, target.outputs);
    pass.dispatchWorkgroups(Math.ceil(view.width / GROUP), Math.ceil((rows.last - rows.first) / GROUP));
    pass.end();
    device.queue.submit([encoder.finish()]);
  }

  present(target: WebGpuTarget): void {
    const { device, pipelines } = this;
    const encoder = device.createCommandEncoder();
    const view = this.context.getCurrentTexture().createView();
    const pass = encoder.beginRenderPass({ colorAttachments: [{ view, loadOp: "clear", storeOp: "store" }] });
    pass.setPipeline(pipelines.copy);
    pass.setBindGroup(0, target.shown);
    pass.draw(3);
    pass.end();
    device.queue.submit([encoder.finish()]);
  }

  async finished(): Promise<void> {
    try {
      await this.device.queue.onSubmittedWorkDone();
    } catch {
      throw new Lost();
    }
  }
}
