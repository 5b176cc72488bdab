"""How xarray writes a dataset of the record into a NetCDF file of the classic format, which has no 64-bit integers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    import xarray

_LARGEST: Final = 2**31 - 1


def fit_classic_netcdf(dataset: xarray.Dataset) -> xarray.Dataset:
    """Return the dataset with encodings as float64 for its times and large whole numbers.

    Times are in ns since the first one, exact up to 104 days later.
    """
    for variable in dataset.variables.values():
        if variable.dtype.kind == "M":
            known = variable.values[~np.isnat(variable.values)]
            first = (known.min() if known.size else np.datetime64(0, "ns")).astype("datetime64[s]")
            variable.encoding = {"units": f"nanoseconds since {first}", "dtype": "float64"}
        elif variable.dtype.kind == "i" and variable.size and np.abs(variable.values).max() > _LARGEST:
            variable.encoding = {"dtype": "float64"}
    return dataset
