// Conversion between the pixels of a scan, metres along its own axes (u, v, from its centre, before rotation), metres in
// the coordinates of the experiment (x, y), and the screen.

export class Geometry {
  /** `box`: the space for the picture on the screen; `view`: {u, v, zoom}, its middle in m and its enlargement. */
  constructor(head, box, view) {
    this.head = head;
    const [width, height] = head.size;
    const [rows, columns] = head.shape;
    this.pitch = [width / Math.max(columns - 1, 1), height / Math.max(rows - 1, 1)];
    this.whole = [width + this.pitch[0], height + this.pitch[1]]; // half a border pixel lies outside
    const fit = Math.min(box.width / this.whole[0], box.height / this.whole[1]);
    this.perMetre = fit * view.zoom;
    const shown = [Math.min(box.width, this.whole[0] * fit), Math.min(box.height, this.whole[1] * fit)];
    this.box = { x: box.x, y: box.y, width: shown[0], height: shown[1] };
    const most = [0, 1].map((i) => Math.max(0, (this.whole[i] - shown[i] / this.perMetre) / 2));
    view.u = Math.min(most[0], Math.max(-most[0], view.u));
    view.v = Math.min(most[1], Math.max(-most[1], view.v));
    this.middle = [view.u, view.v];
  }

  toScreen([u, v]) {
    return [this.box.x + this.box.width / 2 + (u - this.middle[0]) * this.perMetre,
      this.box.y + this.box.height / 2 - (v - this.middle[1]) * this.perMetre];
  }

  fromScreen([x, y]) {
    return [this.middle[0] + (x - this.box.x - this.box.width / 2) / this.perMetre,
      this.middle[1] - (y - this.box.y - this.box.height / 2) / this.perMetre];
  }

  contains([x, y]) {
    const { box } = this;
    return x >= box.x && y >= box.y && x <= box.x + box.width && y <= box.y + box.height;
  }

  /** Return (column, row) with fractions of pixels. */
  pixel([u, v]) {
    return [u / this.pitch[0] + (this.head.shape[1] - 1) / 2, v / this.pitch[1] + (this.head.shape[0] - 1) / 2];
  }

  fromPixel([column, row]) {
    return [(column - (this.head.shape[1] - 1) / 2) * this.pitch[0], (row - (this.head.shape[0] - 1) / 2) * this.pitch[1]];
  }

  /** Return the place (x, y) in the experiment's coordinates. */
  place([u, v]) {
    const cos = Math.cos(this.head.angle), sin = Math.sin(this.head.angle);
    return [this.head.center[0] + cos * u - sin * v, this.head.center[1] + sin * u + cos * v];
  }

  /** Return the place (u, v) of a place (x, y) in the experiment's coordinates. */
  local([x, y]) {
    const [dx, dy] = [x - this.head.center[0], y - this.head.center[1]];
    const cos = Math.cos(this.head.angle), sin = Math.sin(this.head.angle);
    return [cos * dx + sin * dy, cos * dy - sin * dx];
  }

  /** Return [[low, high], [low, high]] of the visible part, along u and v. */
  range() {
    const half = [this.box.width / this.perMetre / 2, this.box.height / this.perMetre / 2];
    return [0, 1].map((i) => [this.middle[i] - half[i], this.middle[i] + half[i]]);
  }
}
