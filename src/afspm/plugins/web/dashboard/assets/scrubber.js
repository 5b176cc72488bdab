// The slider through a night. The page follows: one moment is requested at a time, and of later moments only the newest.

const NIGHT_MS = 60_000; // duration of the playback of a whole night
const FRAME_MS = 250;

export class Scrubber {
  constructor(root, night) {
    Object.assign(this, { root, night, asked: null, next: null, playing: null });
    this.find = (name) => root.querySelector(`[data-part="${name}"]`);
    this.slider = this.find("slider");
    this.begin = BigInt(night.begin);
    this.last = Number((BigInt(night.end) - this.begin) / 1_000_000n) + 1;
    this.times = night.scans.map((scan) => this.#ms(scan.seen));
    Object.assign(this.slider, { max: this.last, value: this.last });
    this.slider.addEventListener("input", () => this.go(Number(this.slider.value)));
    this.slider.addEventListener("keydown", (event) => this.#key(event));
    root.addEventListener("click", (event) => {
      const { step, part } = event.target.closest("button")?.dataset ?? {};
      if (step) this.step(Number(step));
      if (part === "play") this.play(this.playing === null);
    });
    this.#mark();
    this.#tell();
  }

  /** Show the state of the night `ms` after its beginning. */
  go(ms) {
    const moment = Math.max(0, Math.min(this.last, Math.round(ms)));
    this.slider.value = this.next = moment;
    this.#tell();
    this.#ask();
    const scan = this.night.scans.findLast((_, i) => this.times[i] <= moment);
    if (scan) this.#pin(scan);
  }

  /** Go to the end of the previous or next scan. */
  step(by) {
    this.play(false);
    const now = Number(this.slider.value);
    const to = by > 0 ? this.times.find((ms) => ms > now) : this.times.findLast((ms) => ms < now);
    this.go(to ?? (by > 0 ? this.last : 0));
  }

  play(on) {
    clearInterval(this.playing);
    this.playing = null;
    const button = this.find("play");
    if (on) {
      if (Number(this.slider.value) >= this.last) this.go(0);
      this.playing = setInterval(() => {
        if (this.asked !== null) return; // the page is behind
        this.go(Number(this.slider.value) + (this.last * FRAME_MS) / NIGHT_MS);
        if (Number(this.slider.value) >= this.last) this.play(false);
      }, FRAME_MS);
    }
    button.textContent = on ? "❚❚" : "▶";
    button.setAttribute("aria-label", on ? "Stop" : "Play the night");
  }

  /** Register that the page now shows this moment, and request the next. */
  shown(moment) {
    if (this.asked !== null && moment === this.asked) this.asked = null;
    this.#ask();
  }

  #ask() {
    if (this.next === null || this.asked !== null) return;
    this.asked = String(this.begin + BigInt(this.next) * 1_000_000n);
    this.next = null;
    emitEvent("moment", { time: this.asked });
  }

  #pin(scan) {
    const image = window.afspm.image;
    if (!image || image.pinned?.time === scan.time) return;
    const channel = image.find("channel").value;
    image.pin({ time: scan.time, channel: scan.channels.includes(channel) ? channel : scan.channels[0] });
  }

  #key(event) {
    const does = { ArrowRight: () => this.step(1), ArrowUp: () => this.step(1), ArrowLeft: () => this.step(-1),
      ArrowDown: () => this.step(-1), Home: () => this.go(0), End: () => this.go(this.last),
      " ": () => this.play(this.playing === null) }[event.key];
    if (!does || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    does();
  }

  #mark() {
    const marks = [...this.times.map((ms) => ["scan", ms, ""]), ...this.night.notes.map((n) => ["note", this.#ms(n.time), n.text])];
    this.find("marks").replaceChildren(...marks.map(([style, ms, title]) => {
      const mark = document.createElement("i");
      Object.assign(mark, { className: style, title });
      mark.style.left = `${(100 * ms) / this.last}%`;
      return mark;
    }));
  }

  #tell() {
    const ns = this.begin + BigInt(Math.round(Number(this.slider.value))) * 1_000_000n;
    const [, offset_s] = this.night.offsets.findLast(([since], i) => i === 0 || BigInt(since) <= ns);
    const local = new Date(Number(ns / 1_000_000n) + offset_s * 1000);
    const text = local.toISOString().slice(0, 19).replace("T", " ");
    this.find("time").textContent = text;
    this.slider.setAttribute("aria-valuetext", text);
  }

  #ms(time) {
    return Number((BigInt(time) - this.begin) / 1_000_000n) + 1; // rounded up, so that the page has the scan at this moment
  }
}
