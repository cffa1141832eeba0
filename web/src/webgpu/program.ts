// Pipelines of WebGPU: a compute shader for each ray, and what shows a picture.
import { ROWS } from "../drawing/tables";
import { frameSource, programOf } from "../shaders/program";
import type { Header } from "../volume/payload";

/** Pixels along each side of a workgroup. */
export const GROUP = 8;
export const PIXEL_FORMAT = "rgba8unorm";

const TABLES = Object.entries(ROWS).map(
  ([name, type], k) => `@group(0) @binding(${k + 1}) var<storage, read> ${name}: array<${type}>;
fn ${name}At(index: u32) -> ${type} { return ${name}[index]; }`,
);

const MAIN = `
@group(0) @binding(0) var<uniform> frame: Frame;
@group(1) @binding(0) var pixels: texture_storage_2d<${PIXEL_FORMAT}, write>;
@group(1) @binding(1) var<storage, read_write> records: array<u32>;

@compute @workgroup_size(${GROUP}, ${GROUP})
fn trace(@builtin(global_invocation_id) id: vec3u) {
  let pixel = vec2i(id.xy) + vec2i(0, frame.firstRow);
  if (pixel.x >= frame.width || pixel.y >= frame.lastRow) {
    return;
  }
  let ends = traced(vec2f(pixel) + 0.5);
  let color = ends.light.color + ends.light.transmittance * frame.background.xyz;
  textureStore(pixels, pixel, vec4f(color, 1.0));
  records[pixel.y * frame.width + pixel.x] = ends.record;
}`;

const COPY = `
@group(0) @binding(0) var source: texture_2d<f32>;
@group(0) @binding(1) var smoothly: sampler;

struct Corner {
  @builtin(position) position: vec4f,
  @location(0) place: vec2f,
}

// One triangle that covers the screen.
@vertex
fn corner(@builtin(vertex_index) index: u32) -> Corner {
  let place = 2.0 * vec2f(f32(index & 1u), f32(index >> 1u));
  return Corner(vec4f(2.0 * place.x - 1.0, 1.0 - 2.0 * place.y, 0.0, 1.0), place);
}

@fragment
fn copied(@location(0) place: vec2f) -> @location(0) vec4f {
  return vec4f(textureSampleLevel(source, smoothly, place, 0.0).rgb, 1.0);
}`;

export interface Pipelines {
  trace: GPUComputePipeline;
  copy: GPURenderPipeline;
}

/** @param format The canvas's. */
export async function pipelinesOf(device: GPUDevice, header: Header, format: GPUTextureFormat): Promise<Pipelines> {
  const code = [frameSource, ...TABLES, programOf(header), MAIN].join("\n");
  const tracing = device.createShaderModule({ label: "trace", code });
  const copying = device.createShaderModule({ label: "copy", code: COPY });
  const [trace, copy] = await Promise.all([
    device.createComputePipelineAsync({ layout: layoutOf(device), compute: { module: tracing } }),
    device.createRenderPipelineAsync({
      layout: "auto",
      vertex: { module: copying },
      fragment: { module: copying, targets: [{ format }] },
    }),
  ]);
  return { trace, copy };
}

/** Bindings: of the frame and the tables, all of them, whichever a volume needs; of the target. */
function layoutOf(device: GPUDevice): GPUPipelineLayout {
  const visibility = GPUShaderStage.COMPUTE;
  const inputs: GPUBindGroupLayoutEntry[] = [{ binding: 0, visibility, buffer: { type: "uniform" } }];
  TABLES.forEach((_, k) => inputs.push({ binding: k + 1, visibility, buffer: { type: "read-only-storage" } }));
  const outputs: GPUBindGroupLayoutEntry[] = [
    { binding: 0, visibility, storageTexture: { format: PIXEL_FORMAT } },
    { binding: 1, visibility, buffer: { type: "storage" } },
  ];
  const bindGroupLayouts = [inputs, outputs].map((entries) => device.createBindGroupLayout({ entries }));
  return device.createPipelineLayout({ bindGroupLayouts });
}
