// Two finished scans: side by side, one after the other, or their difference.

import { FinishedPictures, drawPicture, offer } from "./pictures.js";

const FLICKER_MS = 600;

export class Comparison {
  constructor(root, night) {
    Object.assign(this, { root, night, mode: "side", turn: 0, odd: false, pair: [], difference: null });
    this.pictures = new FinishedPictures();
    this.find = (name) => root.querySelector(`[data-part="${name}"]`);
    const scans = night.scans.map((scan) => [scan.time, `${scan.number} · ${scan.text}`]);
    for (const name of ["first", "second"]) offer(this.find(name), scans);
    this.#choose();
    for (const select of root.querySelectorAll("select")) select.addEventListener("change", () => this.load());
    root.addEventListener("click", (event) => {
      const { mode } = event.target.closest("button")?.dataset ?? {};
      if (mode) this.show(mode);
    });
    setInterval(() => this.#flicker(), FLICKER_MS);
    new ResizeObserver(() => this.draw()).observe(this.find("left"));
    new MutationObserver(() => this.draw()).observe(document.body, { attributeFilter: ["class"] });
    this.show("side");
  }

  show(mode) {
    this.mode = mode;
    for (const button of this.root.querySelectorAll("[data-mode]")) {
      button.setAttribute("aria-pressed", String(button.dataset.mode === mode));
    }
    this.find("right").hidden = mode !== "side";
    this.load();
  }

  async load() {
    const turn = (this.turn += 1);
    this.#offerChannels();
    const [first, second] = this.#scans();
    if (!first || !second) return;
    const look = { channel: this.find("channel").value, levelling: this.find("levelling").value };
    const asked = [[first, second], [second, first]].map(([scan, other]) =>
      this.pictures.get("live/image", { ...look, time: scan.time, beside: other.time }));
    const change = this.mode !== "difference" ? null
      : this.pictures.get("night/difference", { ...look, first: first.time, second: second.time });
    const [left, right, difference] = await Promise.all([...asked, change]);
    if (turn !== this.turn) return;
    this.pair = [left, right];
    this.difference = difference;
    this.draw();
  }

  draw() {
    const names = this.#scans().map((scan) => scan && `Scan ${scan.number}, ${scan.text}`);
    if (!names[0] || !names[1]) return;
    const [left, right] = this.pair, again = () => this.draw();
    let caption = "";
    if (this.mode === "side") {
      drawPicture(this.find("left"), left, names[0], again);
      drawPicture(this.find("right"), right, names[1], again);
    } else if (this.mode === "flicker") {
      drawPicture(this.find("left"), this.odd ? right : left, names[this.odd ? 1 : 0], again);
    } else {
      drawPicture(this.find("left"), this.difference, `${names[1]} − ${names[0]}`, again);
      caption = this.difference?.words ?? "";
    }
    this.find("caption").textContent = caption;
    this.root.dataset.shown = this.mode === "difference" && !this.difference?.head ? "" : this.mode;
  }

  #scans() {
    return ["first", "second"].map((name) => this.night.scans.find((scan) => scan.time === this.find(name).value));
  }

  /** Choose the last scan, and the first scan of the same size and pixels. */
  #choose() {
    const last = this.night.scans.at(-1);
    if (!last) return;
    const like = this.night.scans.find((scan) => String([scan.size, scan.shape]) === String([last.size, last.shape]));
    this.find("first").value = like.time;
    this.find("second").value = last.time;
  }

  #offerChannels() {
    const [first, second] = this.#scans();
    const both = first?.channels.filter((name) => second?.channels.includes(name)) ?? [];
    offer(this.find("channel"), both.map((name) => [name, name]));
  }

  #flicker() {
    if (this.mode !== "flicker") return;
    this.odd = !this.odd;
    this.draw();
  }
}
