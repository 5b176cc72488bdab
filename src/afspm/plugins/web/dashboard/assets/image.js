// The picture of a scan: axes, colour bar, scale bar, zoom, values under the pointer, profile, and places to measure at.

import { drawAxis, drawColourBar, drawScaleBar, fitted, plain, quantity, scale } from "./axes.js";
import { Pictures, Questions } from "./fetching.js";
import { Geometry } from "./geometry.js";
import { drawProfile } from "./profile.js";

const MARGIN = { left: 58, right: 78, top: 22, bottom: 40 };
const BESIDE = 166; // pixels of the width, for the facts beside the picture
const BELOW = 150; // pixels of the height, for the facts below a wide one
const MOST_ZOOM = 64;

export class ImageView {
  constructor(root) {
    this.root = root;
    this.find = (name) => root.querySelector(`[data-part="${name}"]`);
    this.canvas = this.find("canvas");
    this.head = this.bitmap = this.geometry = this.line = this.drag = this.cursor = this.profile = null;
    this.view = { u: 0, v: 0, zoom: 1 };
    this.tool = "look";
    this.pinned = this.wanted = null;
    this.hasChosenChannel = false;
    this.bar = new Image();
    this.bar.onload = () => this.draw();
    this.pictures = new Pictures((head, bitmap) => this.show(head, bitmap), (text) => this.say(text));
    this.values = new Questions("live/value", (found, asked) => this.showValue(found, asked));
    this.profiles = new Questions("live/profile", (found) => this.showProfile(found));
    this.#listen();
    new ResizeObserver(() => this.draw()).observe(this.find("stage"));
    new MutationObserver(() => this.draw()).observe(document.body, { attributeFilter: ["class"] });
    this.fetch();
  }

  /** Return the parameters of every request about the picture. */
  look() {
    const chosen = Object.fromEntries(["channel", "levelling", "contrast", "palette"].map((n) => [n, this.find(n).value]));
    return this.pinned ? { ...chosen, ...this.pinned } : chosen;
  }

  fetch() {
    const palette = this.find("palette").value;
    if (this.bar.dataset.name !== palette) {
      this.bar.dataset.name = palette;
      this.bar.src = `live/palette/${palette}.png`;
    }
    this.pictures.want(this.look());
  }

  /** Show a finished scan instead of the newest; null: the newest again. */
  pin(scan) {
    this.pinned = scan;
    if (scan) this.#offer([...this.#channels(), scan.channel]);
    if (scan) this.find("channel").value = scan.channel;
    this.root.classList.toggle("pinned", Boolean(scan));
    this.resetView();
    this.fetch();
  }

  /** Offer these channels; one that a person has chosen stays, if it is among them, else the first is shown. */
  setChannels(channels) {
    if (channels.join("\n") !== this.#channels().join("\n")) this.#offer(channels);
  }

  /** Take the number of the newest picture of any channel. */
  hear(newest) {
    this.pictures.hear(newest);
  }

  /** Allow or forbid the choice of places for scans and spectra, and of the place of a grant for an agent. */
  setSteering(may, mayGrant = false) {
    this.root.classList.toggle("may-measure", may);
    this.root.classList.toggle("may-grant", mayGrant);
    const lost = (!may && (this.tool === "scan" || this.tool === "spectrum")) || (!mayGrant && this.tool === "grant");
    if (lost) this.choose("look");
  }

  show(head, bitmap) {
    this.bitmap?.close();
    const other = !this.head || ["center", "size", "angle", "shape"].some((n) => String(head[n]) !== String(this.head[n]));
    Object.assign(this, { head, bitmap });
    if (other) {
      this.resetView();
      this.line = this.profile = null;
    }
    this.draw();
    this.say("");
    this.find("facts").replaceChildren(...head.facts.flatMap(([label, text]) => {
      const [term, fact] = [document.createElement("dt"), document.createElement("dd")];
      [term.textContent, fact.textContent] = [label, text];
      return [term, fact];
    }));
    Object.assign(this.canvas.dataset, { number: head.number, time: head.time_ns ?? "", rows: head.rows, at: Date.now() });
    if (this.cursor) this.#askValue();
    if (this.line) this.#askProfile();
  }

  say(text) {
    this.find("caption").textContent = text;
  }

  /** Outline the scan of an open dialog: {x, y, width, height, angle}; null: no outline. */
  want(scan) {
    this.wanted = scan;
    this.draw();
  }

  choose(tool) {
    this.tool = tool;
    for (const button of this.root.querySelectorAll("[data-tool]")) {
      button.setAttribute("aria-pressed", String(button.dataset.tool === tool));
    }
    this.find("hint").textContent = {
      look: "Drag to move, turn the wheel or pinch to zoom.",
      profile: "Drag a line over the picture.",
      scan: "Drag a rectangle to scan, or click for the middle of a scan of the same size.",
      spectrum: "Click where the spectrum is to be taken.",
      grant: "Drag the rectangle in which an agent may measure.",
    }[tool];
    if (tool !== "profile") this.line = this.profile = null;
    this.find("profile").hidden = tool !== "profile";
    this.draw();
  }

  resetView() {
    this.view = { u: 0, v: 0, zoom: 1 };
  }

  zoomBy(factor, about = null) {
    if (!this.geometry) return;
    const centre = [this.geometry.box.x + this.geometry.box.width / 2, this.geometry.box.y + this.geometry.box.height / 2];
    const screen = about ?? centre;
    const before = this.geometry.fromScreen(screen);
    this.view.zoom = Math.min(MOST_ZOOM, Math.max(1, this.view.zoom * factor));
    this.#measure();
    const after = this.geometry.fromScreen(screen);
    this.view.u += before[0] - after[0];
    this.view.v += before[1] - after[1];
    this.draw();
  }

  draw() {
    this.#fit();
    const area = fitted(this.canvas);
    if (!area) return;
    if (!this.head) {
      area.context.fillText("No scan yet.", 16, 26);
      return;
    }
    this.#measure(area);
    this.#drawPicture(area);
    this.#drawAxes(area);
    this.#drawBar(area);
    this.#drawMarks(area);
    if (this.profile) drawProfile(this.find("profile"), this.profile, this.head.levelling === "none" ? "value" : "levelled value");
  }

  showValue(found, asked) {
    if (!this.cursor) return;
    const [x, y] = this.geometry.place(this.geometry.fromPixel([asked.column, asked.row]));
    const far = scale(Math.max(Math.abs(x), Math.abs(y)), "m");
    const where = `(${plain(x * far.factor, 5)}, ${plain(y * far.factor, 5)}) ${far.unit}`;
    // always in the unit of the colour bar: numbers that jump between units can't be compared
    const of = scale(Math.max(Math.abs(this.head.low), Math.abs(this.head.high)), found.unit);
    const value = found.value === null ? "not measured" : `${plain(found.value * of.factor, 6)} ${of.unit}`;
    const levelled = found.value === null || this.head.levelling === "none" ? ""
      : `, levelled ${plain(found.levelled * of.factor)} ${of.unit}`;
    const readout = this.find("readout");
    readout.textContent = `${value}${levelled} at ${where}`;
    Object.assign(readout.dataset, { value: found.value ?? "", column: asked.column, row: asked.row, number: found.number ?? "" });
  }

  showProfile(found) {
    this.profile = found;
    this.draw();
  }

  // --- within ---

  #channels() {
    return [...this.find("channel").options].map((option) => option.value);
  }

  #offer(channels) {
    const select = this.find("channel"), before = select.value;
    select.replaceChildren(...[...new Set(channels)].map((name) => new Option(name, name)));
    const keeps = (this.pinned || this.hasChosenChannel) && channels.includes(before);
    if (keeps) select.value = before;
    else if (!this.pinned && select.value !== before) this.fetch();
  }

  /** Fit the canvas beside or above the facts, where it is larger; on a phone, where the page scrolls, to the width. */
  #fit() {
    const stage = this.find("stage"), { canvas } = this;
    const [along, across] = this.head?.size ?? [1, 1];
    const across_px = MARGIN.left + MARGIN.right, up_px = MARGIN.top + MARGIN.bottom;
    const [wide, high] = [stage.clientWidth, stage.clientHeight];
    const within = (room, most) => Math.max(0, Math.min((room - across_px) / along, (most - up_px) / across));
    const scrolls = matchMedia("(max-width: 760px)").matches;
    const [beside, above] = [within(wide - BESIDE, high), within(wide, high - BELOW)];
    const isAbove = !scrolls && above > beside;
    stage.classList.toggle("above", isAbove);
    const room = wide - (scrolls || isAbove ? 0 : BESIDE);
    const perMetre = scrolls ? within(wide, Infinity) : Math.max(above, beside);
    const size = [across_px + along * perMetre, up_px + across * perMetre];
    const [width, height] = [Math.min(room, Math.max(size[0], 180)), Math.max(size[1], 160)].map((n) => `${Math.round(n)}px`);
    if (canvas.style.height !== height) canvas.style.height = height;
    if (canvas.style.width !== width) canvas.style.width = width;
  }

  #measure(area = null) {
    const { width, height } = area ?? this.canvas.getBoundingClientRect();
    const box = { x: MARGIN.left, y: MARGIN.top, width: Math.max(20, width - MARGIN.left - MARGIN.right),
      height: Math.max(20, height - MARGIN.top - MARGIN.bottom) };
    this.geometry = new Geometry(this.head, box, this.view);
  }

  #drawPicture({ context }) {
    const { box, whole } = this.geometry;
    const [x, y] = this.geometry.toScreen([-whole[0] / 2, whole[1] / 2]);
    context.save();
    context.beginPath();
    context.rect(box.x, box.y, box.width, box.height);
    context.clip();
    context.globalAlpha = 0.16;
    context.fillRect(box.x, box.y, box.width, box.height); // a faint ground for pixels without a value
    context.globalAlpha = 1;
    context.imageSmoothingEnabled = whole[0] * this.geometry.perMetre < this.head.shape[1];
    context.drawImage(this.bitmap, x, y, whole[0] * this.geometry.perMetre, whole[1] * this.geometry.perMetre);
    if (this.head.newest_row !== null && this.head.newest_row !== undefined && !this.head.time_ns) {
      const at = this.geometry.toScreen(this.geometry.fromPixel([0, this.head.newest_row]))[1];
      context.fillStyle = getComputedStyle(this.canvas).getPropertyValue("--accent");
      context.fillRect(box.x, at - 1, box.width, 2);
    }
    if (this.head.changed_row !== null && this.head.changed_row !== undefined) this.#drawChange(context, box);
    context.restore();
    context.strokeRect(box.x, box.y, box.width, box.height);
  }

  /** Draw a dashed line at the first row with a changed tip: white within black is visible on any colour. */
  #drawChange(context, box) {
    const at = this.geometry.toScreen(this.geometry.fromPixel([0, this.head.changed_row]))[1];
    context.setLineDash([8, 6]);
    for (const [colour, width] of [["rgba(0,0,0,0.7)", 4], ["#fff", 1.6]]) {
      context.strokeStyle = colour;
      context.lineWidth = width;
      context.strokeRect(box.x - 10, at, box.width + 20, 0);
    }
    context.setLineDash([]);
    context.font = "12px sans-serif";
    const text = `tip changed, row ${this.head.changed_row}`;
    const wide = context.measureText(text).width + 12;
    const above = at - 20 > box.y ? at - 20 : at + 3;
    context.fillStyle = "rgba(0,0,0,0.75)";
    context.fillRect(box.x + 6, above, wide, 17);
    context.fillStyle = "#fff";
    context.textAlign = "left";
    context.fillText(text, box.x + 12, above + 13);
  }

  #drawAxes({ context }) {
    const [[left, right], [low, high]] = this.geometry.range();
    const turned = this.head.angle !== 0;
    const from = turned ? [this.head.size[0] / 2, this.head.size[1] / 2] : this.head.center;
    const spans = [[left + from[0], right + from[0]], [low + from[1], high + from[1]]];
    const found = scale(Math.max(...spans.flat().map(Math.abs)), "m"); // one unit for both
    ["x", "y"].forEach((side, i) => {
      drawAxis(context, this.geometry.box, ...spans[i], found, side, turned ? ["along", "across"][i] : side);
    });
    drawScaleBar(context, this.geometry.box, this.geometry.box.width / this.geometry.perMetre);
  }

  #drawBar({ context }) {
    const { box } = this.geometry, { low, high, unit } = this.head;
    const bar = { x: box.x + box.width + 14, y: box.y, width: 14, height: box.height };
    const colours = this.bar.complete && this.bar.naturalWidth ? this.bar : null;
    drawColourBar(context, bar, colours, { low, high, unit });
  }

  #drawMarks({ context }) {
    const scan = this.#scanRectangle();
    context.save();
    // white within black is visible on any colour
    for (const [colour, width] of [["rgba(0,0,0,0.7)", 3.5], ["#fff", 1.4]]) {
      context.strokeStyle = colour;
      context.lineWidth = width;
      context.stroke(this.#marks());
      if (scan) context.stroke(scan.path);
    }
    context.restore();
    if (scan) this.#label(context, scan);
  }

  /** Return outline, place and label of the scan in the dialog, under the drag, or at the cross; null without one. */
  #scanRectangle() {
    if (!this.wanted && this.tool !== "scan" && this.tool !== "grant") return null;
    const { size: all, angle } = this.head;
    let [centre, size, turn] = [null, all, 0];
    if (this.wanted) {
      centre = this.geometry.local([this.wanted.x, this.wanted.y]);
      [size, turn] = [[this.wanted.width, this.wanted.height], this.wanted.angle - angle];
    } else if (this.line && this.drag?.moved) {
      const [a, b] = this.line;
      [centre, size] = [[(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], [Math.abs(a[0] - b[0]), Math.abs(a[1] - b[1])]];
    } else if (this.cursor) centre = this.geometry.fromPixel(this.cursor);
    if (!centre) return null;
    const cos = Math.cos(turn), sin = Math.sin(turn), path = new Path2D();
    const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([i, j]) => [i * size[0] / 2, j * size[1] / 2]);
    const places = corners.map(([u, v]) => this.geometry.toScreen([centre[0] + cos * u - sin * v, centre[1] + sin * u + cos * v]));
    places.forEach((place, i) => (i ? path.lineTo(...place) : path.moveTo(...place)));
    path.closePath();
    const { factor, unit } = scale(Math.max(...size), "m");
    const degrees = ((angle + turn) * 180) / Math.PI;
    const text = `${plain(size[0] * factor)} × ${plain(size[1] * factor)} ${unit}, ${plain(degrees)}°`;
    return { path, text, at: this.geometry.toScreen(centre) };
  }

  #label(context, { text, at }) {
    const { box } = this.geometry;
    context.save();
    context.textAlign = "center";
    const half = context.measureText(text).width / 2 + 6;
    const x = Math.min(box.x + box.width - half, Math.max(box.x + half, at[0]));
    const y = Math.min(box.y + box.height - 8, Math.max(box.y + 22, at[1] + 22));
    context.fillStyle = "rgba(0,0,0,0.75)";
    context.fillRect(x - half, y - 13, 2 * half, 18);
    context.fillStyle = "#fff";
    context.fillText(text, x, y);
    context.restore();
  }

  #marks() {
    const path = new Path2D();
    if (this.line) {
      const [a, b] = this.line.map((place) => this.geometry.toScreen(place));
      if (this.tool === "profile") {
        path.moveTo(...a);
        path.lineTo(...b);
      }
    }
    if (this.cursor) {
      const [x, y] = this.geometry.toScreen(this.geometry.fromPixel(this.cursor));
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        path.moveTo(x + 4 * dx, y + 4 * dy);
        path.lineTo(x + 12 * dx, y + 12 * dy);
      }
    }
    return path;
  }

  #askValue() {
    const [column, row] = this.cursor;
    this.values.ask({ ...this.look(), column, row });
  }

  #askProfile() {
    const [a, b] = this.line.map((place) => this.geometry.pixel(place));
    this.profiles.ask({ ...this.look(), x0: a[0], y0: a[1], x1: b[0], y1: b[1] });
  }

  #point(screen) {
    if (!this.geometry?.contains(screen)) return;
    const [rows, columns] = this.head.shape;
    const [column, row] = this.geometry.pixel(this.geometry.fromScreen(screen)).map(Math.round);
    this.#moveCursor([Math.min(columns - 1, Math.max(0, column)), Math.min(rows - 1, Math.max(0, row))]);
  }

  #moveCursor(pixel) {
    this.cursor = pixel;
    this.#askValue();
    this.draw();
  }

  #measureAt(place, size = null) {
    const [x, y] = this.geometry.place(place);
    const { size: all, angle, shape } = this.head;
    const name = { scan: "scan_here", spectrum: "spectrum_here", grant: "grant_here" }[this.tool];
    const [width, height] = size ?? all;
    if (this.tool === "scan") this.wanted = { x, y, width, height, angle };
    emitEvent(name, { x, y, width, height, angle, rows: shape[0], columns: shape[1] });
  }

  #listen() {
    for (const name of ["channel", "levelling", "contrast", "palette"]) {
      this.find(name).addEventListener("change", () => {
        if (name === "channel") this.hasChosenChannel = true;
        if (name === "channel" && this.pinned) this.pinned = { ...this.pinned, channel: this.find("channel").value };
        this.fetch();
      });
    }
    this.root.addEventListener("click", (event) => {
      const { tool, zoom } = event.target.closest("button")?.dataset ?? {};
      if (tool) this.choose(tool);
      if (zoom === "0") this.resetView();
      else if (zoom) this.zoomBy(Number(zoom));
      if (zoom) this.draw();
      if (event.target.dataset.part === "live") this.pin(null);
    });
    const { canvas } = this;
    canvas.addEventListener("wheel", (event) => {
      if (!this.geometry?.contains([event.offsetX, event.offsetY])) return;
      event.preventDefault();
      this.zoomBy(Math.exp(-event.deltaY * 0.0015), [event.offsetX, event.offsetY]);
    }, { passive: false });
    this.fingers = new Map();
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#move(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.#up(event));
    canvas.addEventListener("keydown", (event) => this.#key(event));
  }

  #down(event) {
    const screen = [event.offsetX, event.offsetY];
    if (!this.geometry?.contains(screen)) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.fingers.set(event.pointerId, screen);
    const place = this.geometry.fromScreen(screen);
    this.drag = { screen, place, view: { ...this.view }, moved: false };
    if (["profile", "scan", "grant"].includes(this.tool)) this.line = [place, place];
    this.#point(screen);
  }

  #move(event) {
    const screen = [event.offsetX, event.offsetY];
    if (this.fingers.size === 2 && this.fingers.has(event.pointerId)) {
      this.#pinch(event.pointerId, screen);
      return;
    }
    if (!this.drag || !this.fingers.has(event.pointerId)) {
      this.#point(screen);
      return;
    }
    this.drag.moved ||= Math.hypot(screen[0] - this.drag.screen[0], screen[1] - this.drag.screen[1]) > 4;
    if (this.tool === "look") {
      this.view.u = this.drag.view.u - (screen[0] - this.drag.screen[0]) / this.geometry.perMetre;
      this.view.v = this.drag.view.v + (screen[1] - this.drag.screen[1]) / this.geometry.perMetre;
    } else if (this.line) {
      this.line[1] = this.geometry.fromScreen(screen);
      if (this.tool === "profile") this.#askProfile();
    }
    this.#point(screen);
    this.draw();
  }

  #pinch(id, screen) {
    const distance = () => {
      const [a, b] = [...this.fingers.values()];
      return Math.hypot(a[0] - b[0], a[1] - b[1]);
    };
    const before = distance();
    this.fingers.set(id, screen);
    if (before > 0) this.zoomBy(distance() / before, screen);
    this.drag = null;
  }

  #up(event) {
    const { drag } = this;
    this.fingers.delete(event.pointerId);
    this.drag = null;
    if (!drag || event.type === "pointercancel") return;
    if (this.tool === "spectrum") this.#measureAt(this.geometry.fromScreen([event.offsetX, event.offsetY]));
    if (this.tool === "scan" || this.tool === "grant") {
      const [a, b] = this.line;
      if (drag.moved) this.#measureAt([(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], [Math.abs(a[0] - b[0]), Math.abs(a[1] - b[1])]);
      else this.#measureAt(a);
      this.line = null;
      this.draw();
    }
  }

  #key(event) {
    if (!this.head || event.ctrlKey || event.metaKey || event.altKey) return;
    const [rows, columns] = this.head.shape;
    const step = event.shiftKey ? 10 : 1;
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (moves[event.key]) {
      const [column, row] = this.cursor ?? [columns >> 1, rows >> 1];
      const [dx, dy] = moves[event.key];
      this.#moveCursor([Math.min(columns - 1, Math.max(0, column + dx)), Math.min(rows - 1, Math.max(0, row + dy))]);
    } else if (event.key === "+" || event.key === "=") this.zoomBy(1.5);
    else if (event.key === "-") this.zoomBy(1 / 1.5);
    else if (event.key === "0") {
      this.resetView();
      this.draw();
    } else if (event.key === "Enter" && this.cursor && (this.tool === "scan" || this.tool === "spectrum")) {
      this.#measureAt(this.geometry.fromPixel(this.cursor));
    } else return;
    event.preventDefault();
  }
}
