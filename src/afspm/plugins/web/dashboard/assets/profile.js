// Values along a line.

import { drawAxis, fitted, scale } from "./axes.js";

export function drawProfile(canvas, { distances_m: distances, values, unit }, label) {
  const area = fitted(canvas);
  const known = values.filter((value) => value !== null);
  if (!area || known.length < 2) return;
  const { context, width, height, accent } = area;
  const box = { x: 62, y: 22, width: width - 82, height: height - 62 };
  let low = Math.min(...known), high = Math.max(...known);
  const around = (high - low) * 0.06 || Math.abs(low) * 0.05 || 1;
  low -= around;
  high += around;
  const end = distances.at(-1) || 1;
  drawAxis(context, box, 0, end, scale(end, "m"), "x", "along the line");
  drawAxis(context, box, low, high, scale(Math.max(Math.abs(low), Math.abs(high)), unit), "y", label);
  context.strokeRect(box.x, box.y, box.width, box.height);
  context.beginPath();
  let pen = false;
  values.forEach((value, i) => {
    if (value === null) {
      pen = false;
      return;
    }
    const x = box.x + (distances[i] / end) * box.width, y = box.y + (1 - (value - low) / (high - low)) * box.height;
    if (pen) context.lineTo(x, y);
    else context.moveTo(x, y);
    pen = true;
  });
  context.strokeStyle = accent;
  context.lineWidth = 1.5;
  context.stroke();
}
