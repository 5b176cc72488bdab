"""Lines of a scan that is still running."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from afspm.errors import InvalidValue
from afspm.model.geometry import Region

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class ScanLines:
    """Some neighbouring rows of one channel, published while the scan goes on.

    Attributes:
        region: of the whole scan.
        shape: of the whole scan, (rows, columns).
        channel, unit: of the values.
        first_row: index in the whole scan of the first of these rows.
        values: [rows, columns], y and x ascending, whatever the order in which they are scanned.
        began_ns: when the scan began, ns since the Unix epoch: the same for all lines of a scan.
    """

    region: Region
    shape: tuple[int, int]
    channel: str
    unit: str
    first_row: int
    values: NDArray[np.float64]
    began_ns: int | None = None

    def __post_init__(self) -> None:
        rows, columns = self.shape
        fits = self.values.ndim == 2 and self.values.shape[1] == columns
        if not fits or not 0 <= self.first_row <= rows - self.values.shape[0]:
            raise InvalidValue(
                f"lines of shape {self.values.shape} from row {self.first_row} on are none of a scan of {self.shape}"
            )

    def into(self, picture: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Return a picture of the whole scan with these lines in it; rows that are not there yet are NaN.

        Args:
            picture: [y, x] with the lines before, which is changed; None: these are the first.
        """
        import numpy as np

        picture = np.full(self.shape, np.nan) if picture is None else picture
        picture[self.first_row : self.first_row + len(self.values)] = self.values
        return picture
