"""Takes an overview, finds its flattest place, and scans that: a component that uses nothing of afspm."""

import numpy as np
from wire_client import END, say, started


def roughness(heights):
    """Return the root mean square of heights about their plane."""
    rows, columns = np.indices(heights.shape)
    plane = np.column_stack([rows.ravel(), columns.ravel(), np.ones(heights.size)])
    return np.sqrt(np.mean((heights.ravel() - plane @ np.linalg.lstsq(plane, heights.ravel(), rcond=None)[0]) ** 2))


client = started()
client.ready()
settings = client.launch["settings"]
size, tiles, pixels = settings["size_m"], settings["tiles"], settings["pixels"]

scans, _ = client.scan((0.0, 0.0), (size, size), 0.0, (pixels, pixels))
heights = next(scan.values for scan in scans if scan.message.params.data.units == "m")

edge = pixels // tiles
corners = [(row * edge, column * edge) for row in range(tiles) for column in range(tiles)]
rms, row, column = min((roughness(heights[r : r + edge, c : c + edge]), r, c) for r, c in corners)

# the first and the last pixel lie on the border of the scan; rows ascend with y
x, y = (((first + (edge - 1) / 2) / (pixels - 1) - 0.5) * size for first in (column, row))
client.scan((x, y), (size / tiles, size / tiles), 0.0, (pixels, pixels))
say(f"INFO scanned the flattest place at ({x * 1e9:.0f}, {y * 1e9:.0f}) nm: {rms * 1e9:.3f} nm rms")
client.demand(END)
client.wait(lambda: False)  # until the end of the experiment ends this program
