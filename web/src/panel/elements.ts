// Elements of the page, in a line each.

type Child = Node | string;

export function make<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  properties: Partial<HTMLElementTagNameMap[K]> = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

/** A control beside its name. */
export function row(name: string, ...controls: Child[]): HTMLLabelElement {
  return make("label", { className: "row" }, make("span", {}, name), ...controls);
}

export function slider(low: number, high: number, value: number, changed: (value: number) => void): HTMLInputElement {
  const input = make("input", { type: "range" });
  Object.assign(input, { min: String(low), max: String(high), step: String((high - low) / 400) });
  input.value = String(value);
  input.addEventListener("input", () => changed(Number(input.value)));
  return input;
}

export function choice(names: string[], chosen: number, changed: (index: number) => void): HTMLSelectElement {
  const select = make("select", {}, ...names.map((name) => make("option", {}, name)));
  select.selectedIndex = chosen;
  select.addEventListener("change", () => changed(select.selectedIndex));
  return select;
}

export function tick(isOn: boolean, changed: (isOn: boolean) => void): HTMLInputElement {
  const input = make("input", { type: "checkbox", checked: isOn });
  input.addEventListener("change", () => changed(input.checked));
  return input;
}

export function colorInput(color: number[], changed: (color: [number, number, number]) => void): HTMLInputElement {
  const input = make("input", { type: "color", value: hexOf(color) });
  input.addEventListener("input", () => changed(colorOf(input.value)));
  return input;
}

export function hexOf(color: number[]): string {
  const bytes = color.map((value) => Math.round(255 * Math.min(Math.max(value, 0), 1)));
  return `#${bytes.map((byte) => byte.toString(16).padStart(2, "0")).join("")}`;
}

function colorOf(hex: string): [number, number, number] {
  const [r, g, b] = [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);
  return [r, g, b];
}

/** A number with about three digits. */
export function short(value: number): string {
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e6)) return value.toExponential(2);
  return String(Number(value.toPrecision(size >= 1000 ? 6 : 3)));
}

/** A whole number with thin spaces. */
export function grouped(value: number): string {
  return String(Math.round(value)).replace(/\B(?=(\d{3})+$)/g, "\u202f");
}
