// When what is drawn: coarse pictures while something changes, a fine one in bands once nothing does.
import { type Audit, type Look, type Renderer, Target } from "./renderer";
import type { Orbit, View } from "./view";

export interface Finished {
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

interface Pending {
  sync: WebGLSync;
  since: number;
  then: (milliseconds: number) => void;
}

export class Stage {
  /** Pixels of the fine picture for one of the screen's. */
  quality = 1;
  /** Parts of the window's width, from the right, and of its height, from below, that the panel covers. */
  covered: [number, number] = [0, 0];
  onFinished: (finished: Finished) => void = () => {};
  onFirst: () => void = () => {};
  private scale = 3;
  private coarse: Target | null = null;
  private fine: Target | null = null;
  private pending: Pending | null = null;
  private isDirty = true;
  private changed = 0;
  private rows = 0; // of the fine picture that are drawn
  private bandRows = 32;
  private spent = 0;
  private isScheduled = false;
  private wasShown = false;
  private waiting: (() => void)[] = []; // for the fine picture

  constructor(
    private readonly gl: WebGL2RenderingContext,
    private readonly renderer: Renderer,
    private readonly orbit: Orbit,
    readonly look: Look,
  ) {
    new ResizeObserver(() => this.change()).observe(gl.canvas as HTMLCanvasElement);
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
    if (!this.fine || this.rows < this.fine.height || this.pending) {
      await new Promise<void>((resolve) => this.waiting.push(resolve));
    }
    const { width, height } = this.fine!;
    const canvas = document.createElement("canvas");
    canvas.width = Math.max(Math.round((1 - this.covered[0]) * width), 1);
    canvas.height = Math.max(Math.round((1 - this.covered[1]) * height), 1);
    const data = new ImageData(new Uint8ClampedArray(this.fine!.pixels()), width, height);
    canvas.getContext("2d")!.putImageData(data, 0, 0);
    return new Promise((resolve) => canvas.toBlob(resolve));
  }

  private schedule(): void {
    if (this.isScheduled) return;
    this.isScheduled = true;
    requestAnimationFrame(() => {
      this.isScheduled = false;
      this.advance();
    });
  }

  private advance(): void {
    const { gl } = this;
    if (gl.isContextLost()) return;
    if (this.pending) {
      if (gl.getSyncParameter(this.pending.sync, gl.SYNC_STATUS) !== gl.SIGNALED) return this.schedule();
      gl.deleteSync(this.pending.sync);
      const { then, since } = this.pending;
      this.pending = null;
      then(performance.now() - since);
    }
    const canvas = gl.canvas as HTMLCanvasElement;
    if (!canvas.clientWidth || !canvas.clientHeight) return;
    if (this.isDirty) {
      this.isDirty = false;
      this.drawCoarse(canvas);
      this.schedule();
    } else if (performance.now() - this.changed < REST) {
      this.schedule();
    } else if (!this.fine || this.rows < this.fine.height) {
      this.drawBand(canvas);
      this.schedule();
    }
  }

  private drawCoarse(canvas: HTMLCanvasElement): void {
    const [width, height] = sizeOf(canvas, 1);
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const view = this.view(canvas, SCALES[this.scale]);
    this.coarse = this.fitting(this.coarse, view);
    const target = this.coarse;
    this.renderer.draw(target, view, this.look);
    this.renderer.present(target);
    this.after((milliseconds) => {
      if (milliseconds > 1.5 * COARSE_GOAL) this.scale = Math.min(this.scale + 1, SCALES.length - 1);
      // Looked at once a frame, so no time is less than one of these.
      if (milliseconds < 0.55 * COARSE_GOAL) this.scale = Math.max(this.scale - 1, 0);
      if (!this.wasShown) {
        this.wasShown = true;
        this.onFirst();
      }
    });
  }

  private drawBand(canvas: HTMLCanvasElement): void {
    const view = this.view(canvas, this.quality);
    this.fine = this.fitting(this.fine, view);
    const target = this.fine;
    const last = Math.min(this.rows + this.bandRows, view.height);
    this.renderer.draw(target, view, this.look, this.rows, last);
    this.rows = last;
    this.after((milliseconds) => {
      this.spent += milliseconds;
      const factor = Math.min(Math.max(BAND_GOAL / Math.max(milliseconds, 1), 0.5), 2);
      this.bandRows = Math.min(Math.max(Math.round(this.bandRows * factor), 4), 4096);
      if (this.isDirty || this.rows < view.height) return;
      this.renderer.present(target);
      const { width, height } = target;
      this.onFinished({ width, height, milliseconds: this.spent, audit: target.audit() });
      for (const resolve of this.waiting.splice(0)) resolve();
    });
  }

  private view(canvas: HTMLCanvasElement, scale: number): View {
    const [width, height] = sizeOf(canvas, scale);
    return this.orbit.view(width, height, this.covered[0] * width, this.covered[1] * height);
  }

  private fitting(target: Target | null, view: View): Target {
    if (target && target.width === view.width && target.height === view.height) return target;
    target?.delete();
    return new Target(this.gl, view.width, view.height);
  }

  private after(then: (milliseconds: number) => void): void {
    const sync = this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE, 0)!;
    this.gl.flush();
    this.pending = { sync, since: performance.now(), then };
  }
}

function sizeOf(canvas: HTMLCanvasElement, scale: number): [number, number] {
  const ratio = Math.min(
    scale * window.devicePixelRatio,
    MOST_PIXELS / Math.max(canvas.clientWidth, canvas.clientHeight),
  );
  return [Math.max(1, Math.round(canvas.clientWidth * ratio)), Math.max(1, Math.round(canvas.clientHeight * ratio))];
}
