// The panel beside the picture.
import { STEP_BOUND } from "../drawing/audit";
import type { Finished, Stage } from "../drawing/stage";
import type { Orbit } from "../drawing/view";
import type { Volume } from "../volume/payload";
import { choice, colorInput, grouped, make, row, short, slider, tick } from "./elements";
import { TransferEditor } from "./transfer_editor";

const QUALITIES = [0.5, 1, 2];
const AXES = ["x", "y", "z"];
// Pixels: of a window in which the panel stands beside the picture and not below, and that it covers there; the same as
// in document.py.
const WIDE = 700;
const COVERED = 324;

export function panelOf(volume: Volume, stage: Stage, orbit: Orbit): HTMLElement {
  const { header } = volume;
  const body = make("div", { className: "body" });
  if (header.transfer) {
    const editor = new TransferEditor(header.transfer, volume.values, (transfer) => {
      stage.look.transfer = transfer;
      stage.change();
    });
    body.append(section(header.scalar ?? "Scalar", editor.element));
  }
  body.append(section("Picture", ...pictureRows(volume, stage, orbit)), section("Cut", ...cutRows(volume, stage)));
  body.append(statistics(volume, stage));
  const toggle = make("button", { type: "button", className: "toggle", title: "Show or hide the panel" });
  const title = make("h1", {}, header.title);
  const panel = make("aside", { className: "panel" }, make("header", {}, title, toggle), body);
  const show = (isOpen: boolean) => {
    panel.classList.toggle("closed", !isOpen);
    toggle.textContent = isOpen ? "\u2212" : "+";
    toggle.setAttribute("aria-expanded", String(isOpen));
    cover();
  };
  const cover = () => {
    const isWide = window.innerWidth >= WIDE;
    const isOpen = !panel.classList.contains("closed");
    stage.covered = isOpen ? (isWide ? [COVERED / window.innerWidth, 0] : [0, 0.5]) : [0, 0];
    stage.change();
  };
  window.addEventListener("resize", cover);
  toggle.addEventListener("click", () => show(panel.classList.contains("closed")));
  show(window.innerWidth >= WIDE);
  return panel;
}

function section(name: string, ...children: Node[]): HTMLElement {
  return make("section", {}, make("h2", {}, name), ...children);
}

function pictureRows(volume: Volume, stage: Stage, orbit: Orbit): HTMLElement[] {
  const { look } = stage;
  const changing =
    <T>(apply: (value: T) => void) =>
    (value: T) => {
      apply(value);
      stage.change();
    };
  const density = slider(-3, 3, 0, changing((value: number) => (look.density = 2 ** value)));
  const names = ["Fast", "Normal", "Fine"];
  const quality = choice(names, 1, changing((index: number) => (stage.quality = QUALITIES[index])));
  const behind = colorInput(
    look.background,
    changing((color: [number, number, number]) => (look.background = color)),
  );
  behind.addEventListener("input", () => (document.documentElement.style.background = behind.value));
  const rows = [row("Density", density), row("Quality", quality), row("Background", behind)];
  if (volume.harmonics) {
    const directional = tick(true, changing((isOn: boolean) => (look.directional = isOn)));
    rows.push(row("Colour by direction", directional));
  }
  const reset = make("button", { type: "button", textContent: "Reset view" });
  reset.addEventListener("click", () => {
    orbit.reset();
    stage.change();
  });
  const save = make("button", { type: "button", textContent: "Save picture" });
  save.addEventListener("click", async () => {
    const picture = await stage.picture();
    if (!picture) return;
    const address = URL.createObjectURL(picture);
    make("a", { href: address, download: `${volume.header.title}.png` }).click();
    URL.revokeObjectURL(address);
  });
  return [...rows, make("div", { className: "buttons" }, reset, save)];
}

function cutRows({ header: { box } }: Volume, stage: Stage): HTMLElement[] {
  const state = { axis: -1, place: 0, isFlipped: false };
  const place = slider(-0.5, 0.5, 0, (value) => update({ place: value }));
  const where = make("output", { className: "where" });
  const flip = tick(false, (isFlipped) => update({ isFlipped }));
  const update = (change: Partial<typeof state>) => {
    Object.assign(state, change);
    place.disabled = flip.disabled = state.axis < 0;
    const sign = state.isFlipped ? 1 : -1;
    const normal = AXES.map((_, axis) => (axis === state.axis ? sign : 0));
    where.textContent = state.axis < 0 ? "" : short(box.center[state.axis] + box.size * state.place);
    stage.look.clip = state.axis < 0 ? null : [normal[0], normal[1], normal[2], -sign * state.place];
    stage.change();
  };
  const axis = choice(["Nothing", ...AXES.map((name) => `Across ${name}`)], 0, (index) => update({ axis: index - 1 }));
  place.disabled = flip.disabled = true;
  return [row("Cut away", axis), row("Place", where, place), row("Other side", flip)];
}

function statistics(volume: Volume, stage: Stage): HTMLElement {
  const { header } = volume;
  const drawn = make("p", { className: "drawn" }, "\u2026");
  stage.onFinished = (finished) => {
    drawn.replaceChildren(...describe(finished).flatMap((line) => [line, make("br")]));
  };
  const size = `${grouped(header.cells)} cells, ${grouped(header.vertices)} vertices`;
  return make("section", { className: "statistics" }, make("p", {}, size), drawn);
}

function describe({ by, width, height, milliseconds, audit }: Finished): string[] {
  return [
    `${width} \u00d7 ${height} pixels in ${grouped(milliseconds)} ms`,
    `${grouped(audit.meanSteps)} cells a ray, at most ${grouped(audit.mostSteps)}`,
    `${grouped(audit.lost)} rays lost, ${grouped(audit.bounded)} ended at ${grouped(STEP_BOUND)} cells`,
    `Drawn by ${by.join(". ")}`,
  ];
}
