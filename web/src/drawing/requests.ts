// Pictures that other scripts ask for.
import type { Header, Vector } from "../volume/payload";
import { type Audit, auditOf } from "./audit";
import type { Look, Renderer } from "./renderer";
import { add, dot, scaled, type View } from "./view";

/** In the words of difftetvr.Camera and the units of the mesh. */
export interface Request {
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

export interface Answer {
  /** RGBA of 8 bits from the top row on, in base64. */
  pixels: string;
  audit: Audit;
}

/** @param look How the volume is drawn where the request does not say it. */
export async function answered(renderer: Renderer, { box }: Header, look: Look, request: Request): Promise<Answer> {
  const { center, size } = box;
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
  const clip: Look["clip"] = plane ? [...scaled(normal, size), dot(normal, center) + plane[3]] : null;
  const target = renderer.target(width, height);
  try {
    const background = request.background ?? look.background;
    renderer.draw(target, view, { ...look, background, clip }, { first: 0, last: height });
    return { pixels: base64Of(await target.pixels()), audit: auditOf(await target.records()) };
  } finally {
    target.delete();
  }
}

function base64Of(bytes: Uint8Array): string {
  const parts: string[] = [];
  for (let i = 0; i < bytes.length; i += 0x8000) parts.push(String.fromCharCode(...bytes.subarray(i, i + 0x8000)));
  return btoa(parts.join(""));
}
