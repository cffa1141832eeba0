// What a renderer does, whatever it is made with.
import type { TransferKnots, Vector } from "../volume/payload";
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
  /** What scalars look like; null: the volume has colours. Replaced, not changed. */
  transfer: TransferKnots | null;
}

/** Rows of a picture, counted from the top. */
export interface Rows {
  first: number;
  /** That after the last one. */
  last: number;
}

/** A picture that is being drawn, on the graphics card. */
export interface Target {
  readonly width: number;
  readonly height: number;
  /** (width height 4) bytes, from the top row on. */
  pixels(): Promise<Uint8Array<ArrayBuffer>>;
  /** (width height) of what happened to each ray, in any order: see STEPS in walk.wgsl. */
  records(): Promise<Uint32Array>;
  delete(): void;
}

export interface Renderer {
  /** What it is made with, as people call it. */
  readonly name: string;
  /** Where it presents pictures. */
  readonly canvas: HTMLCanvasElement;
  /** Fulfilled with the reason, as soon as nothing can be drawn any more. */
  readonly lost: Promise<string>;
  target(width: number, height: number): Target;
  draw(target: Target, view: View, look: Look, rows: Rows): void;
  /** Shows a target on the canvas. */
  present(target: Target): void;
  /** Fulfilled as soon as all is drawn that was asked for. */
  finished(): Promise<void>;
}

/** What a renderer's promises are rejected with where it is lost meanwhile. */
export class Lost extends Error {
  constructor() {
    super("The graphics card has given up on this picture; ask again.");
  }
}
