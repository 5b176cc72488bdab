"""One component looks where it is interesting, the other measures there: neither knows how the other works."""

import numpy as np

from afspm import Component, Region, wire
from afspm.basics import Length
from afspm.model import ChannelName

MESSAGE = "SpatialPointWithScoreList"


class RandomPoints(Component):
    """Chooses random points of each wide scan, and publishes how rough the sample is around each."""

    listens = ("Scan2d",)
    publishes = (MESSAGE,)

    def __init__(self, points: int = 20, around: Length = 400e-9, channel: ChannelName = "height"):
        self.points, self.around, self.channel = points, around, channel

    def on_scan(self, scan):
        if not scan.is_of(self.channel) or min(scan.region.size_m) <= self.around:
            return  # a narrow one
        message = wire.message_type(MESSAGE)(channel=scan.channel)
        message.timestamp.FromNanoseconds(scan.time_ns)
        x_m, y_m = scan.region.pixels_m(scan.shape)
        for row, column in self._chosen(scan):
            near = np.hypot(x_m - x_m[row, column], y_m - y_m[row, column]) < self.around / 2
            entry = message.spatials.add(score=float(np.std(scan.values[near]) * 1e9))
            entry.spatial.point.x, entry.spatial.point.y = x_m[row, column], y_m[row, column]
            entry.spatial.units = "m"
        self.publish(message)

    def _chosen(self, scan):
        """Pixels around which there is a whole narrow scan; of the same scan always the same."""
        random = np.random.default_rng(scan.time_ns)
        margin = [
            round(n * self.around / size / 2) for n, size in zip(scan.shape, scan.region.size_m[::-1], strict=True)
        ]
        return [
            [random.integers(edge, n - edge) for n, edge in zip(scan.shape, margin, strict=True)]
            for _ in range(self.points)
        ]


class BestPoints(Component):
    """Takes a wide scan, then narrow ones where the best of its points are, and begins again."""

    listens = (MESSAGE, "ControlState")

    def __init__(
        self,
        size: Length = 2e-6,
        narrow: Length = 400e-9,
        pixels: int = 128,
        rounds: int = 3,
        best: int = 3,
    ):
        self.size, self.narrow, self.pixels = size, narrow, pixels
        self.rounds, self.best = rounds, best

    def run(self):
        wide = Region((0.0, 0.0), (self.size, self.size))
        with self.scope.events(MESSAGE, timeout_s=600.0) as lists:
            for number in range(self.rounds):
                for place in self._places(wide, number, lists):
                    self._look_closer(place, number)
                self.scope.progress(number + 1, self.rounds)
        self.scope.end_experiment()

    def _places(self, wide, number, lists):
        """The best points of a wide scan, once they are told; of another scan if nobody tells them."""
        for attempt in range(3):
            scans = self.scope.scan(wide, shape=(self.pixels, self.pixels), key=f"wide-{number}-{attempt}")
            for event in lists:
                if event.message.timestamp.ToNanoseconds() == scans.first.time_ns:
                    ranked = sorted(event.message.spatials, key=lambda one: one.score, reverse=True)
                    return [(one.spatial.point.x, one.spatial.point.y) for one in ranked[: self.best]]
        raise RuntimeError("nobody tells the points of a wide scan")

    def _look_closer(self, place, number):
        region = Region(place, (self.narrow, self.narrow))
        key = f"narrow-{number}-{place[0]:.12g}-{place[1]:.12g}"
        scan = self.scope.scan(region, shape=(self.pixels, self.pixels), key=key).first
        self.log.info("%.2f nm rms at (%.0f nm, %.0f nm)", scan.values.std() * 1e9, *(1e9 * m for m in place))
