"""The sites of a lattice are found in a scan and classified by height; one of each kind is measured."""

import csv

import numpy as np
from scipy import ndimage
from sites_picture import COLOURS, draw

from afspm import Component, Region
from afspm.basics import Length


def lattice_sites(heights):
    """Return rows and columns of the sites: tops of the periodic part of the heights, in which no atom is missing."""
    waves = np.fft.fftshift(np.fft.fft2(heights))
    number = np.hypot(*np.meshgrid(*(np.arange(n) - n // 2 for n in heights.shape), indexing="ij"))
    power = np.where(number > 8, np.abs(waves), 0.0)  # fewer waves in the whole scan are tilt and noise
    spots = ndimage.binary_dilation(power > power.max() / 3, iterations=3)  # a strained lattice has wide spots
    periodic = np.fft.ifft2(np.fft.ifftshift(waves * spots)).real
    spacing = len(heights) / number.flat[power.argmax()]  # of the rows of atoms, in pixels
    is_top = periodic == ndimage.maximum_filter(periodic, round(0.7 * spacing))
    edge = round(spacing)
    rows, columns = np.nonzero(is_top[edge:-edge, edge:-edge])
    return rows + edge, columns + edge, spacing


def classified(heights, clear=5.0):
    """Return the kind of each site: another kind is apart from the atoms by `clear` times the scatter of heights."""
    above = heights - np.median(heights)
    scatter = 1.48 * np.median(np.abs(above))
    kinds = np.full(len(heights), "atom", dtype=object)
    for kind, sign in (("adatom", 1.0), ("vacancy", -1.0)):
        beyond = np.sort(sign * above[sign * above > 0.0])
        widest = np.diff(beyond).argmax()
        if beyond[widest + 1] - beyond[widest] > clear * scatter:
            kinds[sign * above > beyond[widest]] = kind
    return kinds


class LatticeDefects(Component):
    """Classifies the sites of a scan, and takes a zoom and a curve at the most central site of each kind."""

    def __init__(self, size: Length = 8e-9, zoom: Length = 1.5e-9, pixels: int = 256, channel: str = "Height"):
        self.size, self.zoom, self.pixels, self.channel = size, zoom, pixels, channel

    def run(self):
        wide = Region((0.0, 0.0), (self.size, self.size))
        scan = self.scope.scan(wide, shape=(self.pixels, self.pixels), key="overview")[self.channel]
        heights = scan.values - np.median(scan.values, axis=1, keepdims=True)
        rows, columns, spacing = lattice_sites(heights)
        heights = ndimage.gaussian_filter(heights, spacing / 5)
        kinds = classified(heights[rows, columns])
        x_m, y_m = (axis[rows, columns] for axis in scan.region.pixels_m(scan.shape))
        curves = {}
        for kind in COLOURS:
            of_kind = np.flatnonzero(kinds == kind)
            self.log.info("%s: %d of %d sites", kind, len(of_kind), len(kinds))
            if len(of_kind):
                site = min(of_kind, key=lambda one: np.hypot(x_m[one], y_m[one]))
                place = (float(x_m[site]), float(y_m[site]))
                self.scope.scan(Region(place, (self.zoom, self.zoom)), shape=(64, 64), key=f"zoom-{kind}")
                curves[site] = self.scope.spectrum(place, kind="IV", key=f"curve-{kind}")
        with (self.run_dir / "sites.csv").open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["x_m", "y_m", "kind", "measured"])
            for site, row in enumerate(zip(x_m, y_m, kinds, strict=True)):
                writer.writerow([*row, "yes" if site in curves else "no"])
        title = self.name + ", SIMULATED" * self.simulated
        draw(self.run_dir / "sites.png", title, 1e9 * self.size, heights, (1e9 * x_m, 1e9 * y_m), kinds, curves)
        self.scope.end_experiment()
