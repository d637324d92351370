"""Files of time stamps."""

import numpy as np
from jaxtyping import Float64

from jaxtri.errors import InputError
from jaxtri.formats.files import PathLike, check_rows, read_rows


def read_timestamps(path: PathLike) -> Float64[np.ndarray, " t"]:
    """Read the first column, seconds, of a file of time stamps (file names and so on may follow).

    Raises `InputError` with the line of the first that is not a finite number or does not increase.
    """
    lines, values = read_rows(path, 1, "seconds", InputError, more=True)
    check_rows(path, lines[1:], np.diff(values[:, 0]) > 0, "time stamps must increase strictly", InputError)
    return values[:, 0]
