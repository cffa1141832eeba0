// When what is drawn: coarse pictures while something changes, a fine one in bands once nothing does.
import { type Audit, auditOf } from "./audit";
import { type Look, Lost, type Renderer, type Target } from "./renderer";
import type { Orbit, View } from "./view";

export interface Finished {
  /** Name of the renderer, and why those before it do not draw, in sentences. */
  by: [string, ...string[]];
  width: number;
  height: number;
  /** Of drawing, without the waiting in between. */
  milliseconds: number;
  audit: Audit;
}

const COARSE_GOAL = 40;
const BAND_GOAL = 50;
const REST = 150;
/** Pixels of a coarse picture, as parts of the window's. */
const SCALES = [1, 0.7, 0.5, 0.35, 0.25, 0.18, 0.125, 0.09];
const MOST_PIXELS = 4096;
/** Bands are of whole rows of blocks of so many rows. */
const BLOCK_ROWS = 8;
const MOST_BLOCKS = 512;

export class Stage {
  /** Pixels of the fine picture for one of the screen's. */
  quality = 1;
  /** Parts of the window's width, from the right, and of its height, from below, that the panel covers. */
  covered: [number, number] = [0, 0];
  onFinished: (finished: Finished) => void = () => {};
  onFirst: () => void = () => {};
  private renderer: Renderer | null = null;
  private reasons: string[] = [];
  private scale = 3;
  private coarse: Target | null = null;
  private fine: Target | null = null;
  private isBusy = false;
  private isDirty = true;
  private changed = 0;
  private rows = 0; // of the fine picture that are drawn
  private bandBlocks = 4;
  private spent = 0;
  private isScheduled = false;
  private wasShown = false;
  private waiting: (() => void)[] = []; // for the fine picture

  /** @param place Element that is filled by the picture. */
  constructor(
    private readonly place: HTMLElement,
    private readonly orbit: Orbit,
    readonly look: Look,
  ) {
    new ResizeObserver(() => this.change()).observe(place);
  }

  /** Draws with a renderer from now on; one that did before is lost.
   *
   * @param reasons Why those before it do not draw.
   */
  use(renderer: Renderer, reasons: string[]): void {
    this.renderer = renderer;
    this.reasons = reasons;
    this.coarse = this.fine = null;
    this.isBusy = false;
    this.place.replaceChildren(renderer.canvas);
    this.change();
  }

  /** To be called when the view or the look is another. */
  change(): void {
    this.isDirty = true;
    this.rows = 0;
    this.spent = 0;
    this.changed = performance.now();
    this.schedule();
  }

  /** The fine picture as PNG, without what the panel covers, as soon as there is one. */
  async picture(): Promise<Blob | null> {
    if (!this.fine || this.rows < this.fine.height || this.isBusy) {
      await this.nextFine();
    }
    const { width, height } = this.fine!;
    const pixels = await this.fine!.pixels().catch(() => null);
    if (!pixels) return this.nextFine().then(() => this.picture());
    const canvas = document.createElement("canvas");
    canvas.width = Math.max(Math.round((1 - this.covered[0]) * width), 1);
    canvas.height = Math.max(Math.round((1 - this.covered[1]) * height), 1);
    const data = new ImageData(new Uint8ClampedArray(pixels), width, height);
    canvas.getContext("2d")!.putImageData(data, 0, 0);
    return new Promise((resolve) => canvas.toBlob(resolve));
  }

  private nextFine(): Promise<void> {
    return new Promise((resolve) => this.waiting.push(resolve));
  }

  private schedule(): void {
    if (this.isScheduled) return;
    this.isScheduled = true;
    requestAnimationFrame(() => {
      this.isScheduled = false;
      if (this.renderer && !this.isBusy) this.advance(this.renderer);
    });
  }

  private advance(renderer: Renderer): void {
    const { clientWidth, clientHeight } = this.place;
    if (!clientWidth || !clientHeight) return;
    if (this.isDirty) {
      this.isDirty = false;
      void this.work(renderer, this.drawCoarse(renderer));
    } else if (performance.now() - this.changed < REST) {
      this.schedule();
    } else if (!this.fine || this.rows < this.fine.height) {
      void this.work(renderer, this.drawBand(renderer));
    }
  }

  /** Goes on when something is drawn, if it is still this renderer that draws. */
  private async work(renderer: Renderer, drawing: Promise<void>): Promise<void> {
    this.isBusy = true;
    try {
      await drawing;
    } catch (error) {
      if (!(error instanceof Lost)) throw error;
      return; // until another renderer is to be used
    }
    if (renderer !== this.renderer) return;
    this.isBusy = false;
    this.schedule();
  }

  private async drawCoarse(renderer: Renderer): Promise<void> {
    const { canvas } = renderer;
    const [width, height] = this.sizeAt(1);
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const view = this.view(SCALES[this.scale]);
    const target = (this.coarse = fitting(renderer, this.coarse, view));
    const began = performance.now();
    renderer.draw(target, view, this.look, { first: 0, last: view.height });
    renderer.present(target);
    await renderer.finished();
    if (renderer !== this.renderer) return;
    const milliseconds = performance.now() - began;
    if (milliseconds > 1.5 * COARSE_GOAL) this.scale = Math.min(this.scale + 1, SCALES.length - 1);
    // Some renderers look once a frame, so no time is less than one of these.
    if (milliseconds < 0.55 * COARSE_GOAL) this.scale = Math.max(this.scale - 1, 0);
    if (!this.wasShown) {
      this.wasShown = true;
      this.onFirst();
    }
  }

  private async drawBand(renderer: Renderer): Promise<void> {
    const view = this.view(this.quality);
    const target = (this.fine = fitting(renderer, this.fine, view));
    const rows = { first: this.rows, last: Math.min(this.rows + BLOCK_ROWS * this.bandBlocks, view.height) };
    const began = performance.now();
    renderer.draw(target, view, this.look, rows);
    this.rows = rows.last;
    await renderer.finished();
    if (renderer !== this.renderer) return;
    const milliseconds = performance.now() - began;
    this.spent += milliseconds;
    const factor = Math.min(Math.max(BAND_GOAL / Math.max(milliseconds, 1), 0.5), 2);
    this.bandBlocks = Math.min(Math.max(Math.round(this.bandBlocks * factor), 1), MOST_BLOCKS);
    if (this.isDirty || this.rows < view.height) return;
    renderer.present(target);
    const audit = auditOf(await target.records());
    if (this.isDirty || renderer !== this.renderer) return;
    const { width, height } = target;
    this.onFinished({ by: [renderer.name, ...this.reasons], width, height, milliseconds: this.spent, audit });
    for (const resolve of this.waiting.splice(0)) resolve();
  }

  private view(scale: number): View {
    const [width, height] = this.sizeAt(scale);
    return this.orbit.view(width, height, this.covered[0] * width, this.covered[1] * height);
  }

  private sizeAt(scale: number): [number, number] {
    const { clientWidth, clientHeight } = this.place;
    const ratio = Math.min(scale * window.devicePixelRatio, MOST_PIXELS / Math.max(clientWidth, clientHeight));
    return [Math.max(1, Math.round(clientWidth * ratio)), Math.max(1, Math.round(clientHeight * ratio))];
  }
}

function fitting(renderer: Renderer, target: Target | null, { width, height }: View): Target {
  if (target && target.width === width && target.height === height) return target;
  target?.delete();
  return renderer.target(width, height);
}
