// Numbers and axes, drawn on a canvas.

const PREFIXES = [[1e12, "T"], [1e9, "G"], [1e6, "M"], [1e3, "k"], [1, ""], [1e-3, "m"], [1e-6, "µ"], [1e-9, "n"],
  [1e-12, "p"], [1e-15, "f"]];
const PREFIXABLE = new Set(["m", "V", "A", "s", "N", "Hz", "W", "F", "m/s", "m/V", "V/m", "C", "Pa", "Ohm", "Ω", "T", "g"]);

/** Return {factor, unit} for numbers up to `largest`: the shown number is value * factor. */
export function scale(largest, unit) {
  if (!PREFIXABLE.has(unit) || !Number.isFinite(largest) || largest === 0) return { factor: 1, unit };
  const size = Math.abs(largest) * 1.0005;
  const [power, prefix] = PREFIXES.find(([p]) => size >= p) ?? PREFIXES.at(-1);
  return { factor: 1 / power, unit: prefix + unit };
}

/** Return a value with its unit, such as "12.34 nm"; "–" for null, NaN and infinity. */
export function quantity(value, unit, digits = 4) {
  if (value === null || !Number.isFinite(value)) return "–";
  const found = scale(value, unit);
  return `${plain(value * found.factor, digits)} ${found.unit}`.trim();
}

export function plain(value, digits = 4) {
  return String(Number(value.toPrecision(digits))).replace("-", "−");
}

/** Return about `about` round ticks in [low, high]. */
export function ticks(low, high, about) {
  if (!(high > low)) return [low];
  let step = 10 ** Math.floor(Math.log10((high - low) / about));
  step *= [1, 2, 5, 10].find((factor) => (high - low) / (step * factor) <= about) ?? 10;
  const first = Math.ceil(low / step - 1e-9), last = Math.floor(high / step + 1e-9);
  return Array.from({ length: last - first + 1 }, (_, i) => (first + i) * step);
}

/** Draw ticks and numbers below (`side` "x") or to the left ("y") of a box; `found` is a result of `scale`. */
export function drawAxis(context, box, low, high, found, side, label) {
  const length = side === "x" ? box.width : box.height;
  const values = ticks(low * found.factor, high * found.factor, Math.max(2, length / (side === "x" ? 80 : 48)));
  context.textAlign = side === "x" ? "center" : "right";
  context.textBaseline = side === "x" ? "top" : "middle";
  for (const value of values) {
    const at = (value / found.factor - low) / (high - low);
    const x = side === "x" ? box.x + at * box.width : box.x;
    const y = side === "x" ? box.y + box.height : box.y + (1 - at) * box.height;
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(side === "x" ? x : x - 4, side === "x" ? y + 4 : y);
    context.stroke();
    context.fillText(plain(value, 6), side === "x" ? x : x - 6, side === "x" ? y + 6 : y);
  }
  const text = found.unit ? `${label} / ${found.unit}` : label;
  if (side === "x") {
    context.textAlign = "right";
    context.fillText(text, box.x + box.width, box.y + box.height + 20);
  } else {
    context.textAlign = "left";
    context.textBaseline = "bottom";
    context.fillText(text, Math.max(2, box.x - 52), box.y - 5);
  }
}

/** Draw a colour bar from low to high, with numbers and unit; only its frame until `colours` is loaded. */
export function drawColourBar(context, { x, y, width, height }, colours, { low, high, unit }) {
  if (colours) context.drawImage(colours, x, y, width, height);
  context.strokeRect(x, y, width, height);
  const found = scale(Math.max(Math.abs(low), Math.abs(high)), unit);
  context.textAlign = "left";
  context.textBaseline = "middle";
  for (const value of ticks(low * found.factor, high * found.factor, Math.max(2, height / 48))) {
    const at = (value / found.factor - low) / (high - low);
    context.fillText(plain(value), x + width + 5, y + height * (1 - at));
  }
  context.textBaseline = "bottom";
  context.fillText(found.unit, x, y - 5);
}

/** Draw a scale bar of a round length, in the lower left corner of the box. */
export function drawScaleBar(context, box, width_m) {
  const power = 10 ** Math.floor(Math.log10(width_m * 0.4));
  const round = power * [5, 2, 1].find((factor) => factor * power <= width_m * 0.4);
  const length = (round / width_m) * box.width;
  const x = box.x + 12, y = box.y + box.height - 14;
  const text = quantity(round, "m", 3);
  const wide = Math.max(length, context.measureText(text).width) + 14;
  context.save();
  context.fillStyle = "rgba(0,0,0,0.55)";
  context.fillRect(x - 7, y - 22, wide, 30);
  context.fillStyle = "#fff";
  context.fillRect(x, y - 2, length, 4);
  context.textAlign = "left";
  context.textBaseline = "bottom";
  context.fillText(text, x, y - 5);
  context.restore();
}

/** Return the canvas, cleared and sized in screen pixels; null while its element is too small or hidden. */
export function fitted(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const { width, height } = canvas.getBoundingClientRect();
  if (width < 40 || height < 40) return null;
  const wanted = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== wanted[0] || canvas.height !== wanted[1]) [canvas.width, canvas.height] = wanted;
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  const style = getComputedStyle(canvas);
  context.font = `12px ${style.fontFamily}`;
  context.fillStyle = context.strokeStyle = style.color;
  context.lineWidth = 1;
  return { context, width, height, accent: style.getPropertyValue("--accent").trim() || "#0b7285" };
}
