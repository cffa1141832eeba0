// The page: unpacks the volume, draws it, listens.
import { listen } from "./gestures";
import { make } from "./elements";
import { panelOf } from "./panel";
import style from "./page.css";
import { unpack, type Header, type Vector, type Volume } from "./payload";
import { type Audit, type Look, Renderer, Target } from "./renderer";
import { Stage } from "./stage";
import { add, dot, Orbit, scaled, type View } from "./view";

/** A picture that other scripts ask for, in the words of difftetvr.Camera and the units of the mesh. */
interface Request {
  worldToCamera: number[][];
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  width: number;
  height: number;
  background?: Vector;
  clip?: [number, number, number, number];
}

/** What other scripts can do with the page. */
interface Page {
  header: Header;
  /** RGBA of 8 bits from the top row on, in base64, and what happened to the rays. */
  render(request: Request): { pixels: string; audit: Audit };
}

declare global {
  interface Window {
    difftetvr?: Page;
  }
}

async function start(): Promise<void> {
  document.head.append(make("style", { textContent: style }));
  const canvas = make("canvas", { className: "picture", tabIndex: 0 });
  canvas.setAttribute("aria-label", "The volume; drag to turn it");
  const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, depth: false });
  if (!gl) throw new Error("This browser has no WebGL 2, or it is switched off; this picture is all it can show.");
  const volume = await unpack(document.getElementById("volume")!.textContent!);
  const { header } = volume;
  const renderer = new Renderer(gl, volume);
  const orbit = new Orbit(header.opening);
  const look: Look = { background: header.background, clip: null, density: 1, directional: true };
  const stage = new Stage(gl, renderer, orbit, look);
  stage.onFirst = () => document.getElementById("poster")?.classList.add("gone");
  canvas.addEventListener("webglcontextlost", () => {
    tell(new Error("The graphics driver has given up on this page; load it again, with another quality."));
  });
  listen(canvas, orbit, () => stage.change());
  document.body.append(canvas, panelOf(volume, renderer, stage, orbit));
  window.difftetvr = { header, render: (request) => rendered(gl, renderer, volume, look, request) };
  stage.change();
}

function rendered(
  gl: WebGL2RenderingContext,
  renderer: Renderer,
  { header }: Volume,
  look: Look,
  request: Request,
): { pixels: string; audit: Audit } {
  const { center, size } = header.box;
  const [right, down, forward] = request.worldToCamera.slice(0, 3).map((row) => row.slice(0, 3) as Vector);
  const shift = request.worldToCamera.slice(0, 3).map((row) => row[3]) as Vector;
  const eye = add(add(scaled(right, -shift[0]), down, -shift[1]), forward, -shift[2]);
  const { width, height, fx, fy, cx, cy } = request;
  const view: View = {
    eye: scaled(add(eye, center, -1), 1 / size),
    right,
    down,
    forward,
    lens: [fx, fy, cx, cy],
    width,
    height,
  };
  const plane = request.clip;
  const normal = plane?.slice(0, 3) as Vector;
  const clip = plane && ([...scaled(normal, size), dot(normal, center) + plane[3]] as [number, number, number, number]);
  const target = new Target(gl, width, height);
  renderer.draw(target, view, { ...look, background: request.background ?? look.background, clip: clip ?? null });
  const answer = { pixels: base64Of(target.pixels()), audit: target.audit() };
  target.delete();
  return answer;
}

function base64Of(bytes: Uint8Array): string {
  const parts: string[] = [];
  for (let i = 0; i < bytes.length; i += 0x8000) parts.push(String.fromCharCode(...bytes.subarray(i, i + 0x8000)));
  return btoa(parts.join(""));
}

function tell(error: unknown): void {
  const sentence = error instanceof Error ? error.message : String(error);
  document.getElementById("poster")?.classList.remove("gone");
  document.body.append(make("p", { className: "failure" }, sentence));
}

start().catch(tell);
