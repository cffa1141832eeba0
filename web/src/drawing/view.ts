// Where the eye is, and what it sees: an orbit around a point, in the page's units (see payload.ts).
import type { Opening, Vector } from "../volume/payload";

/** What one picture shows. */
export interface View {
  eye: Vector;
  right: Vector;
  down: Vector;
  forward: Vector;
  /** fx, fy, cx, cy in pixels. */
  lens: [number, number, number, number];
  width: number;
  height: number;
}

export const dot = (a: Vector, b: Vector) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const add = (a: Vector, b: Vector, factor = 1): Vector => [
  a[0] + factor * b[0],
  a[1] + factor * b[1],
  a[2] + factor * b[2],
];
export const scaled = (a: Vector, factor: number): Vector => [factor * a[0], factor * a[1], factor * a[2]];
export const cross = (a: Vector, b: Vector): Vector => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
export const normalised = (a: Vector): Vector => scaled(a, 1 / (Math.hypot(...a) || 1));

function turned(v: Vector, axis: Vector, angle: number): Vector {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return add(add(scaled(v, c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
}

const STEEPEST = Math.cos((3 * Math.PI) / 180);

export class Orbit {
  private target: Vector = [0, 0, 0];
  private up: Vector = [0, 0, 1];
  private offset: Vector = [0, -1, 0]; // from the target to the eye
  private fov = 0.9;

  constructor(private readonly opening: Opening) {
    this.reset();
  }

  reset(): void {
    this.target = this.opening.target;
    this.up = normalised(this.opening.up);
    this.offset = add(this.opening.eye, this.opening.target, -1);
    this.fov = (this.opening.fov * Math.PI) / 180;
  }

  /** Turns the eye around the target; angles in radians, to the right and upwards. */
  turn(across: number, upwards: number): void {
    let offset = turned(this.offset, this.up, -across);
    const axis = normalised(cross(this.up, offset));
    const tilted = turned(offset, axis, -upwards);
    // Not over the poles, where right and left change sides.
    const steepness = Math.abs(dot(tilted, this.up)) / Math.hypot(...tilted);
    if (steepness < STEEPEST || steepness < Math.abs(dot(offset, this.up)) / Math.hypot(...offset)) offset = tilted;
    this.offset = offset;
  }

  /** Changes the distance from the target; more than 1: away. */
  zoom(factor: number): void {
    const distance = Math.hypot(...this.offset) * factor;
    this.offset = scaled(normalised(this.offset), Math.min(Math.max(distance, 0.02), 50));
  }

  /** Moves the picture by parts of its shorter side. */
  pan(across: number, down: number): void {
    const size = 2 * Math.hypot(...this.offset) * Math.tan(this.fov / 2);
    const view = this.view(1, 1);
    this.target = add(add(this.target, view.right, -across * size), view.down, -down * size);
  }

  /** The view in a picture of some size, of which columns on the right and rows at the bottom are covered. */
  view(width: number, height: number, columns = 0, rows = 0): View {
    const free = [Math.max(width - columns, 1), Math.max(height - rows, 1)];
    const forward = normalised(scaled(this.offset, -1));
    const right = normalised(cross(forward, this.up));
    const focal = (0.5 * Math.min(...free)) / Math.tan(this.fov / 2);
    return {
      eye: add(this.target, this.offset),
      right,
      down: cross(forward, right),
      forward,
      lens: [focal, focal, free[0] / 2, free[1] / 2],
      width,
      height,
    };
  }
}
