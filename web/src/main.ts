// The page: unpacks the volume, draws it, listens.
import { type Answer, answered, type Request } from "./drawing/requests";
import type { Look } from "./drawing/renderer";
import { Stage } from "./drawing/stage";
import { Orbit } from "./drawing/view";
import { sentenceOf } from "./errors";
import { make } from "./panel/elements";
import { listen } from "./panel/gestures";
import style from "./panel/page.css";
import { panelOf } from "./panel/panel";
import { draw } from "./renderers";
import { type Header, unpack } from "./volume/payload";

/** What other scripts can do with the page. */
interface Page {
  header: Header;
  /** What draws it. */
  renderer: string;
  render(request: Request): Promise<Answer>;
}

declare global {
  interface Window {
    difftetvr?: Page;
  }
}

async function start(): Promise<never> {
  document.head.append(make("style", { textContent: style }));
  const picture = make("div", { className: "picture", tabIndex: 0 });
  picture.setAttribute("role", "img");
  picture.setAttribute("aria-label", "The volume; drag to turn it");
  const volume = await unpack(document.getElementById("volume")!.textContent!);
  const { header } = volume;
  const orbit = new Orbit(header.opening);
  const { background, transfer = null } = header;
  const look: Look = { background, clip: null, density: 1, directional: true, transfer };
  const stage = new Stage(picture, orbit, look);
  stage.onFirst = () => document.getElementById("poster")?.classList.add("gone");
  listen(picture, orbit, () => stage.change());
  const panel = panelOf(volume, stage, orbit);
  window.addEventListener("hashchange", () => location.reload());
  return draw(volume, location.hash, (renderer, reasons) => {
    if (!picture.isConnected) document.body.append(picture, panel);
    stage.use(renderer, reasons);
    window.difftetvr = { header, renderer: renderer.name, render: (request) => answered(renderer, header, look, request) };
  });
}

function tell(error: unknown): void {
  document.getElementById("poster")?.classList.remove("gone");
  document.body.append(make("p", { className: "failure" }, sentenceOf(error)));
}

start().catch(tell);
