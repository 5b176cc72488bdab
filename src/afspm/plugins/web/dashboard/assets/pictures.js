// Pictures of finished scans, drawn beside each other.

import { drawColourBar, drawScaleBar, fitted } from "./axes.js";

const KEPT = 120;

/** A cache of {head, bitmap} of finished scans by request; the `KEPT` last used stay. */
export class FinishedPictures {
  #kept = new Map();

  get(path, query) {
    const key = `${path}?${new URLSearchParams(query)}`;
    const found = this.#kept.get(key) ?? this.#fetch(key);
    this.#kept.delete(key);
    this.#kept.set(key, found);
    if (this.#kept.size > KEPT) this.#kept.delete(this.#kept.keys().next().value);
    return found;
  }

  async #fetch(key) {
    try {
      const answer = await fetch(key);
      if (!answer.ok) return { trouble: await answer.text() };
      const [head, words] = ["X-Frame", "X-Words"].map((name) => JSON.parse(answer.headers.get(name)));
      return { head, words, bitmap: await createImageBitmap(await answer.blob()) };
    } catch {
      this.#kept.delete(key);
      return { trouble: "The connection to the dashboard is lost." };
    }
  }
}

const bars = new Map();

/** Return a colour map as a picture; null until loaded, then `loaded` is called. */
function colourBar(palette, loaded) {
  if (!bars.has(palette)) {
    const bar = new Image();
    bar.src = `live/palette/${palette}.png`;
    bars.set(palette, bar);
  }
  const bar = bars.get(palette);
  if (!bar.complete) bar.addEventListener("load", loaded, { once: true });
  return bar.complete && bar.naturalWidth ? bar : null;
}

/** Draw a picture as large as fits, with scale bar, colour bar and a title. */
export function drawPicture(canvas, picture, title, again) {
  const area = fitted(canvas);
  if (!area) return;
  const { context, width, height } = area;
  context.textBaseline = "top";
  context.fillText(title, 2, 4);
  if (!picture?.head) {
    context.fillText(picture?.trouble ?? "…", 2, 26);
    return;
  }
  const { head, bitmap } = picture, room = [width - 84, height - 46];
  const perMetre = Math.min(room[0] / head.size[0], room[1] / head.size[1]);
  const box = { x: 0.5, y: 40.5, width: head.size[0] * perMetre, height: head.size[1] * perMetre };
  context.imageSmoothingEnabled = box.width < bitmap.width;
  context.drawImage(bitmap, box.x, box.y, box.width, box.height);
  context.strokeRect(box.x, box.y, box.width, box.height);
  drawScaleBar(context, box, head.size[0]);
  drawColours(context, box, head, again);
}

function drawColours(context, box, { low, high, unit, palette }, again) {
  const bar = { x: box.x + box.width + 10, y: box.y, width: 12, height: box.height };
  drawColourBar(context, bar, colourBar(palette, again), { low, high, unit });
}

/** Fill a select; the chosen option stays if it is still offered. */
export function offer(select, options) {
  const before = select.value;
  select.replaceChildren(...options.map(([value, text]) => new Option(text, value)));
  if (options.some(([value]) => value === before)) select.value = before;
}
