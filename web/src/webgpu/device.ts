// The graphics card as WebGPU offers it.
import type { Table } from "../drawing/tables";

/** Rejected with a sentence where there is none.
 *
 * @param takesAny Whether also one is taken that the browser computes on the CPU, where WebGL 2 may have a real one.
 */
export async function adapterFor(takesAny: boolean): Promise<GPUAdapter> {
  if (!navigator.gpu) throw new Error("This browser has no WebGPU.");
  const adapter = await navigator.gpu.requestAdapter();
  if (!adapter) throw new Error("WebGPU finds no graphics card here.");
  if (adapter.info.isFallbackAdapter && !takesAny) throw new Error("WebGPU would compute on the CPU here.");
  return adapter;
}

/** Rejected with a sentence where such tables are too large for it. */
export async function deviceFor(adapter: GPUAdapter, tables: Table[]): Promise<GPUDevice> {
  const bytes = Math.max(...tables.map((table) => table.byteLength));
  const { maxBufferSize, maxStorageBufferBindingSize } = adapter.limits;
  if (bytes > Math.min(maxBufferSize, maxStorageBufferBindingSize)) {
    throw new Error("WebGPU's buffers are too small here for a volume of so many cells.");
  }
  // Limits that are less than what every device has do no harm.
  return adapter.requestDevice({ requiredLimits: { maxBufferSize: bytes, maxStorageBufferBindingSize: bytes } });
}

/** Begins something on a device; rejected where it has not worked, which WebGPU does not say by itself. */
export async function checked<T>(device: GPUDevice, begin: () => Promise<T>): Promise<T> {
  for (const filter of ["validation", "out-of-memory"] as const) device.pushErrorScope(filter);
  const result = begin();
  result.catch(() => {}); // the errors below say more
  for (const error of await Promise.all([device.popErrorScope(), device.popErrorScope()])) {
    if (error) throw new Error(`WebGPU fails here: ${error.message}`);
  }
  return result;
}
