// The transfer function as a curve whose knots can be dragged, added, taken away and coloured.
import type { TransferKnots, Vector } from "../volume/payload";
import { colorInput, hexOf, make, row, short } from "./elements";

interface Knot {
  scalar: number;
  opacity: number;
  color: Vector;
}

const WIDTH = 264;
const HEIGHT = 132;
const EDGE = 9;
const REACH = 12;

export class TransferEditor {
  readonly element: HTMLElement;
  private knots: Knot[] = [];
  private chosen = -1;
  private readonly canvas = make("canvas", { className: "curve", tabIndex: 0 });
  private readonly picker = colorInput([1, 1, 1], (color) => this.paint(color));
  private readonly note = make("output");
  private readonly histogram: number[];

  constructor(
    private readonly original: TransferKnots,
    values: Float32Array,
    private readonly changed: (transfer: TransferKnots) => void,
  ) {
    this.histogram = histogramOf(values);
    this.canvas.setAttribute("aria-label", "Opacity of scalars: knots to drag");
    const reset = make("button", { type: "button", textContent: "Reset" });
    reset.addEventListener("click", () => this.reset());
    this.element = make(
      "div",
      {},
      this.canvas,
      make("div", { className: "ends" }, short(original.range[0]), this.note, short(original.range[1])),
      row("Colour of the knot", this.picker, reset),
      make("p", { className: "hint" }, "Drag knots; double-click adds or removes one."),
    );
    const ratio = Math.max(1, window.devicePixelRatio);
    [this.canvas.width, this.canvas.height] = [WIDTH * ratio, HEIGHT * ratio];
    this.canvas.getContext("2d")!.scale(ratio, ratio);
    this.listen();
    this.load();
  }

  private load(): void {
    const { scalar, opacity, color } = this.original;
    this.knots = scalar.map((value, k) => ({ scalar: value, opacity: opacity[k], color: color[k] }));
    this.choose(-1);
  }

  private reset(): void {
    this.load();
    this.tell();
  }

  private tell(): void {
    this.changed({
      ...this.original,
      scalar: this.knots.map((knot) => knot.scalar),
      opacity: this.knots.map((knot) => knot.opacity),
      color: this.knots.map((knot) => knot.color),
    });
    this.draw();
  }

  private choose(index: number): void {
    this.chosen = index;
    this.picker.disabled = index < 0;
    if (index >= 0) this.picker.value = hexOf(this.knots[index].color);
    this.draw();
  }

  private paint(color: Vector): void {
    if (this.chosen < 0) return;
    this.knots[this.chosen].color = color;
    this.tell();
  }

  private listen(): void {
    const { canvas } = this;
    let isHeld = false;
    const at = (event: MouseEvent) => {
      const box = canvas.getBoundingClientRect();
      return [((event.clientX - box.left) * WIDTH) / box.width, ((event.clientY - box.top) * HEIGHT) / box.height];
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      const [x, y] = at(event);
      this.choose(this.nearest(x, y));
      isHeld = this.chosen >= 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!isHeld) return;
      const [x, y] = at(event);
      this.move(scalarAt(x), opacityAt(y));
    });
    canvas.addEventListener("pointerup", () => (isHeld = false));
    canvas.addEventListener("dblclick", (event) => {
      const [x, y] = at(event);
      const near = this.nearest(x, y);
      if (near >= 0) this.remove(near);
      else this.insert(scalarAt(x), opacityAt(y));
    });
    canvas.addEventListener("keydown", (event) => {
      if (event.key === "Delete" || event.key === "Backspace") this.remove(this.chosen);
    });
  }

  private nearest(x: number, y: number): number {
    let [found, least] = [-1, REACH];
    this.knots.forEach((knot, k) => {
      const distance = Math.hypot(xOf(knot.scalar) - x, yOf(knot.opacity) - y);
      if (distance < least) [found, least] = [k, distance];
    });
    return found;
  }

  /** Moves the chosen knot, but not past its neighbours. */
  private move(scalar: number, opacity: number): void {
    const knot = this.knots[this.chosen];
    const [low, high] = [this.knots[this.chosen - 1]?.scalar ?? 0, this.knots[this.chosen + 1]?.scalar ?? 1];
    knot.scalar = Math.min(Math.max(scalar, low), high);
    knot.opacity = opacity;
    this.tell();
  }

  private insert(scalar: number, opacity: number): void {
    const place = this.knots.filter((knot) => knot.scalar <= scalar).length;
    this.knots.splice(place, 0, { scalar, opacity, color: this.valueAt(scalar).color });
    this.choose(place);
    this.tell();
  }

  private remove(index: number): void {
    if (index < 0 || this.knots.length < 2) return;
    this.knots.splice(index, 1);
    this.choose(-1);
    this.tell();
  }

  private valueAt(scalar: number): Knot {
    const upper = this.knots.findIndex((knot) => knot.scalar > scalar);
    if (upper < 0) return this.knots[this.knots.length - 1];
    if (upper === 0) return this.knots[0];
    const [a, b] = [this.knots[upper - 1], this.knots[upper]];
    const weight = (scalar - a.scalar) / (b.scalar - a.scalar || 1);
    const mixed = (x: number, y: number) => x + weight * (y - x);
    const color = a.color.map((value, k) => mixed(value, b.color[k])) as Vector;
    return { scalar, opacity: mixed(a.opacity, b.opacity), color };
  }

  private draw(): void {
    const context = this.canvas.getContext("2d")!;
    context.clearRect(0, 0, WIDTH, HEIGHT);
    const base = HEIGHT - EDGE;
    const bar = (WIDTH - 2 * EDGE) / this.histogram.length;
    context.fillStyle = "rgb(255 255 255 / 0.13)";
    this.histogram.forEach((height, k) => {
      context.fillRect(EDGE + k * bar, base - height * (base - EDGE), bar, height * (base - EDGE));
    });
    for (let x = EDGE; x < WIDTH - EDGE; x++) {
      const value = this.valueAt(scalarAt(x + 0.5));
      context.fillStyle = `${hexOf(value.color)}d0`;
      context.fillRect(x, yOf(value.opacity), 1, base - yOf(value.opacity));
      context.fillStyle = hexOf(value.color);
      context.fillRect(x, base, 1, EDGE - 2);
    }
    context.strokeStyle = "rgb(255 255 255 / 0.85)";
    context.lineWidth = 1.5;
    context.beginPath();
    for (let x = EDGE; x <= WIDTH - EDGE; x++) context.lineTo(x, yOf(this.valueAt(scalarAt(x)).opacity));
    context.stroke();
    this.knots.forEach((knot, k) => {
      context.beginPath();
      context.arc(xOf(knot.scalar), yOf(knot.opacity), k === this.chosen ? 6.5 : 5, 0, 7);
      context.fillStyle = hexOf(knot.color);
      context.fill();
      context.strokeStyle = k === this.chosen ? "#7cc4ff" : "#fff";
      context.lineWidth = k === this.chosen ? 2.5 : 1.5;
      context.stroke();
    });
    this.note.textContent = this.chosen < 0 ? "" : this.describe(this.knots[this.chosen]);
  }

  private describe(knot: Knot): string {
    const [low, high] = this.original.range;
    return `${short(low + knot.scalar * (high - low))}: opacity ${short(knot.opacity)}`;
  }
}

const xOf = (scalar: number) => EDGE + scalar * (WIDTH - 2 * EDGE);
const scalarAt = (x: number) => Math.min(Math.max((x - EDGE) / (WIDTH - 2 * EDGE), 0), 1);
// Low opacities matter most in volumes, so the axis is that of the square root.
const yOf = (opacity: number) => HEIGHT - EDGE - Math.sqrt(opacity) * (HEIGHT - 2 * EDGE);
const opacityAt = (y: number) => Math.min(Math.max((HEIGHT - EDGE - y) / (HEIGHT - 2 * EDGE), 0), 1) ** 2;

/** Shares of the scalars, relative to the greatest one, on the same axis as opacities. */
function histogramOf(values: Float32Array): number[] {
  const counts = new Array<number>(66).fill(0);
  for (let i = 3; i < values.length; i += 4) {
    if (values[i] >= 0 && values[i] <= 1) counts[Math.min(65, Math.floor(values[i] * 66))]++;
  }
  const most = Math.max(1, ...counts);
  return counts.map((count) => Math.sqrt(count / most));
}
