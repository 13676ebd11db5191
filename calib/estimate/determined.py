"""Which parameters the data determine: one decision for files and for the agent."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.model import Array

Flags = NDArray[np.bool_]
DETERMINED_SHARE = 0.5  # of the prior's standard uncertainty, which the data must halve (contract)
DETERMINED_U = 0.1  # of the largest main sensitivity, where there is no prior (contract)


def determined(values: Array, u: Array, prior_u: Array, seen: Flags) -> Flags:
    """(12,) of S row by row and Q: the data halve the prior's standard uncertainty.

    `values`, `u` (12,) of the estimate; `prior_u` (12,) before any data, inf where nothing was known: there the data
    must leave less than a tenth of the largest main sensitivity, and have excited what the parameter responds to
    (`seen`).
    """
    limit = DETERMINED_U * float(np.abs(values[[0, 4, 8]]).max())
    return np.asarray(np.where(np.isfinite(prior_u), u < DETERMINED_SHARE * prior_u, seen & (u <= limit)))
