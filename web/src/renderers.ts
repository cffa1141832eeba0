// Which renderer draws: WebGPU, and WebGL 2 where that cannot, from the beginning or from some time on.
import type { Renderer } from "./drawing/renderer";
import { sentenceOf } from "./errors";
import type { Volume } from "./volume/payload";
import { openWebGl } from "./webgl/renderer";
import { openWebGpu } from "./webgpu/renderer";

type Opener = (volume: Volume) => Promise<Renderer>;

/** Openers of renderers, the best first, by what follows # in the page's address. */
function openersFor(hash: string): Opener[] {
  if (hash === "#webgl") return [openWebGl];
  return [(volume) => openWebGpu(volume, hash === "#webgpu"), openWebGl];
}

// Milliseconds: a driver that has crashed takes a moment to start again.
const PATIENCE = 5000;
const PAUSE = 250;

/** Opens a renderer, again and again while it cannot be opened. */
async function patiently(open: Opener, volume: Volume): Promise<Renderer> {
  const deadline = performance.now() + PATIENCE;
  for (;;) {
    try {
      return await open(volume);
    } catch (error) {
      if (performance.now() > deadline) throw error;
    }
    await new Promise((resolve) => setTimeout(resolve, PAUSE));
  }
}

/** Opens one renderer after the other, each when the one before cannot be opened or is lost.
 *
 * @param take Gets each, with the sentences why those before it do not draw.
 * @returns Never: it is rejected with the last one's sentence when none is left.
 */
export async function draw(
  volume: Volume,
  hash: string,
  take: (renderer: Renderer, reasons: string[]) => void,
): Promise<never> {
  const reasons: string[] = [];
  let hasLost = false;
  for (const open of openersFor(hash)) {
    const opening = hasLost ? patiently(open, volume) : open(volume);
    const renderer = await opening.catch((error: unknown) => void reasons.push(sentenceOf(error)));
    if (!renderer) continue;
    take(renderer, [...reasons]);
    reasons.push(await renderer.lost);
    hasLost = true;
  }
  throw new Error(reasons[reasons.length - 1]);
}
