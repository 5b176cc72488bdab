// The scans of a night one after the other, in tip coordinates and in sample coordinates.

import { drawScaleBar, fitted } from "./axes.js";
import { FinishedPictures, offer } from "./pictures.js";

const PAGE_MS = 350;

export class Flipbook {
  constructor(root, night) {
    this.root = root;
    this.scans = night.scans.filter((scan) => scan.tip);
    this.pictures = new FinishedPictures();
    this.playing = null;
    this.turn = 0;
    this.find = (name) => root.querySelector(`[data-part="${name}"]`);
    this.slider = this.find("slider");
    this.slider.max = this.scans.length - 1;
    offer(this.find("channel"), [...new Set(this.scans.flatMap((scan) => scan.channels))].map((name) => [name, name]));
    this.views = Object.fromEntries(["tip", "sample"].map((where) => [where, this.#view(where)]));
    const side = Math.max(this.views.tip.side, this.views.sample.side);
    for (const view of Object.values(this.views)) view.side = side;
    this.slider.addEventListener("input", () => this.show());
    this.find("channel").addEventListener("change", () => this.show());
    this.find("play").addEventListener("click", () => this.play(this.playing === null));
    new ResizeObserver(() => this.draw()).observe(this.find("tip"));
    new MutationObserver(() => this.draw()).observe(document.body, { attributeFilter: ["class"] });
    this.show();
  }

  play(on) {
    clearInterval(this.playing);
    this.playing = on ? setInterval(() => {
      if (!this.loading) this.#turn();
    }, PAGE_MS) : null;
    this.find("play").textContent = on ? "❚❚" : "▶";
    this.find("play").setAttribute("aria-label", on ? "Stop" : "Play");
  }

  async show() {
    const turn = (this.turn += 1), scan = this.scans[Number(this.slider.value)];
    this.loading = true;
    const picture = await this.pictures.get("live/image", { time: scan.time, channel: this.find("channel").value });
    if (turn !== this.turn) return;
    this.loading = false;
    Object.assign(this, { scan, picture });
    this.find("caption").textContent = `Scan ${scan.number}, ${scan.text} (${1 + Number(this.slider.value)} of ${this.scans.length})`;
    this.draw();
    this.root.dataset.shown = scan.number;
  }

  draw() {
    for (const where of ["tip", "sample"]) this.#draw(where);
  }

  #turn() {
    const next = Number(this.slider.value) + 1;
    this.slider.value = next % this.scans.length;
    this.show();
  }

  /** Return the smallest square around all frames, with a margin. */
  #view(where) {
    const [x, y] = [0, 1].map((i) => {
      const low = Math.min(...this.scans.map((scan) => scan[where][i] - scan.size[i] / 2));
      const high = Math.max(...this.scans.map((scan) => scan[where][i] + scan.size[i] / 2));
      return [low, high];
    });
    return { center: [(x[0] + x[1]) / 2, (y[0] + y[1]) / 2], side: 1.05 * Math.max(x[1] - x[0], y[1] - y[0]) };
  }

  #draw(where) {
    const area = fitted(this.find(where));
    if (!area || !this.scan) return;
    const { context, width, height, accent } = area, view = this.views[where];
    const perMetre = Math.min(width, height) / view.side;
    const at = ([x, y]) => [width / 2 + (x - view.center[0]) * perMetre, height / 2 - (y - view.center[1]) * perMetre];
    const size = this.scan.size.map((side) => side * perMetre);
    context.save();
    context.translate(...at(this.scan[where]));
    context.rotate(-this.scan.angle);
    if (this.picture?.bitmap) context.drawImage(this.picture.bitmap, -size[0] / 2, -size[1] / 2, ...size);
    context.strokeRect(-size[0] / 2, -size[1] / 2, ...size);
    context.restore();
    context.strokeStyle = context.fillStyle = accent;
    context.beginPath();
    for (const scan of this.scans.slice(0, 1 + Number(this.slider.value))) context.lineTo(...at(scan[where]));
    context.lineWidth = 2;
    context.stroke();
    const side = Math.min(width, height);
    drawScaleBar(context, { x: (width - side) / 2, y: (height - side) / 2, width: side, height: side }, view.side);
  }
}
