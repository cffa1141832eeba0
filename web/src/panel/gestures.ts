// Mouse, touch and keys: what they do to the orbit.
import type { Orbit } from "../drawing/view";

const KEY_ANGLE = Math.PI / 24;

export function listen(surface: HTMLElement, orbit: Orbit, changed: () => void): void {
  const fingers = new Map<number, [number, number]>();

  surface.addEventListener("pointerdown", (event) => {
    surface.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    surface.classList.add("held");
  });
  for (const name of ["pointerup", "pointercancel"] as const) {
    surface.addEventListener(name, (event) => {
      fingers.delete(event.pointerId);
      if (!fingers.size) surface.classList.remove("held");
    });
  }
  surface.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const size = Math.min(surface.clientWidth, surface.clientHeight);
    const now: [number, number] = [event.clientX, event.clientY];
    const step = [(now[0] - before[0]) / size, (now[1] - before[1]) / size];
    const other = [...fingers].find(([id]) => id !== event.pointerId)?.[1];
    if (other) {
      // Two fingers: each of them moves the middle by half of its step.
      orbit.pan(step[0] / 2, step[1] / 2);
      const apart = (point: [number, number]) => Math.hypot(point[0] - other[0], point[1] - other[1]);
      orbit.zoom(apart(before) / Math.max(apart(now), 1));
    } else if (event.shiftKey || event.buttons & 6) {
      orbit.pan(step[0], step[1]);
    } else {
      orbit.turn(Math.PI * step[0], Math.PI * step[1]);
    }
    fingers.set(event.pointerId, now);
    changed();
  });
  surface.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode === 1 ? 16 : event.deltaMode === 2 ? 400 : 1);
      orbit.zoom(Math.exp(Math.min(Math.max(pixels, -300), 300) / 600));
      changed();
    },
    { passive: false },
  );
  surface.addEventListener("contextmenu", (event) => event.preventDefault());
  surface.addEventListener("keydown", (event) => {
    const act = KEYS[event.key];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act(orbit);
    changed();
  });
}

const KEYS: Record<string, (orbit: Orbit) => void> = {
  ArrowLeft: (orbit) => orbit.turn(-KEY_ANGLE, 0),
  ArrowRight: (orbit) => orbit.turn(KEY_ANGLE, 0),
  ArrowUp: (orbit) => orbit.turn(0, -KEY_ANGLE),
  ArrowDown: (orbit) => orbit.turn(0, KEY_ANGLE),
  "+": (orbit) => orbit.zoom(0.9),
  "=": (orbit) => orbit.zoom(0.9),
  "-": (orbit) => orbit.zoom(1 / 0.9),
  r: (orbit) => orbit.reset(),
  R: (orbit) => orbit.reset(),
};
