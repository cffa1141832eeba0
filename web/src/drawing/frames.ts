// What of a picture is not the volume's: its view and look, as renderers need them.
import { seenFrom } from "../volume/harmonics";
import type { TransferKnots, Vector, Volume } from "../volume/payload";
import { STEP_BOUND } from "./audit";
import type { Look, Rows } from "./renderer";
import type { Tables } from "./tables";
import type { View } from "./view";

export interface Frame {
  /** Content of the struct Frame in frame.wgsl. */
  block: ArrayBuffer;
  /** Tables that are others than in the picture before. */
  tables: Tables;
}

export const FRAME_BYTES = 144;

/** The frames of one renderer, one after the other. */
export class Frames {
  private readonly nodeCount: number; // boxes of the hierarchy
  private readonly places: Float32Array | null;
  private seen: Float32Array<ArrayBuffer> | null = null;
  private seenBy = "";
  private transfer: TransferKnots | null = null;

  /** @param tables The volume's. */
  constructor(
    private readonly volume: Volume,
    tables: Tables,
  ) {
    this.nodeCount = tables.nodes!.length / 8;
    this.places = volume.harmonics ? placesOf(volume) : null;
  }

  next(view: View, look: Look, rows: Rows): Frame {
    const tables: Tables = {};
    const colors = this.colorsFor(view.eye, look.directional);
    if (colors) tables.colors = colors;
    if (look.transfer && look.transfer !== this.transfer) tables.knots = knotsOf(look.transfer);
    this.transfer = look.transfer;
    return { block: this.blockOf(view, look, rows), tables };
  }

  private blockOf({ eye, right, down, forward, lens, width, height }: View, look: Look, rows: Rows): ArrayBuffer {
    const block = new ArrayBuffer(FRAME_BYTES);
    const floats = new Float32Array(block);
    [eye, right, down, forward, lens, look.clip ?? [], look.background].forEach((row, k) => floats.set(row, 4 * k));
    floats[28] = look.density;
    const knotCount = look.transfer?.scalar.length ?? 0;
    new Int32Array(block).set([this.nodeCount, knotCount, STEP_BOUND, width, height, rows.first, rows.last], 29);
    return block;
  }

  /** Colours as they are seen from somewhere; null: they are the same as before. */
  private colorsFor(eye: Vector, directional: boolean): Float32Array<ArrayBuffer> | null {
    const { header, harmonics, values } = this.volume;
    const key = harmonics && directional ? eye.join() : "";
    if (this.seen && key === this.seenBy) return null;
    this.seenBy = key;
    if (header.kind === "scalar" && header.location === "vertex") return (this.seen = new Float32Array(4));
    this.seen ??= values.slice();
    if (key) seenFrom(this.seen, values, this.places!, harmonics!.coefficients, harmonics!.degree, eye);
    else this.seen.set(values);
    return this.seen;
  }
}

function knotsOf(transfer: TransferKnots): Float32Array<ArrayBuffer> {
  const knots = new Float32Array(8 * transfer.scalar.length);
  transfer.scalar.forEach((scalar, k) => {
    knots[8 * k] = scalar;
    knots.set([...transfer.color[k], transfer.opacity[k] * transfer.density], 8 * k + 4);
  });
  return knots;
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
