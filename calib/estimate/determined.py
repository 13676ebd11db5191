"""The decision which parameters the data determine; files and streams share it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.model import Array

Flags = NDArray[np.bool_]
# Both numbers are part of the definition of "determined" in docs/vocabulary.md.
DETERMINED_SHARE = 0.5  # of the prior's standard uncertainty
DETERMINED_U = 0.1  # largest u of a parameter without a prior, relative to the largest main sensitivity
SHOWN = 2.0  # standard uncertainties: a smaller element of S may be zero, and is no measure for others


def determined(values: Array, u: Array, prior_u: Array, seen: Flags) -> Flags:
    """(12,) flags of the determined parameters, S row by row, then Q.

    `values`, `u` (12,) are the estimate and its standard uncertainty; `prior_u` (12,) is the standard uncertainty
    before any data, inf without a prior; `seen` (12,) is true if the direction that a parameter responds to was
    excited. A parameter with a prior is determined if u is below half of `prior_u`. A parameter without a prior is
    determined if it was seen and u is at most a tenth of the largest main sensitivity, which is elsewhere in S where
    the axes are exchanged.
    """
    limit = DETERMINED_U * float(np.abs(values[:9]).max(initial=0.0, where=np.abs(values[:9]) > SHOWN * u[:9]))
    return np.asarray(np.where(np.isfinite(prior_u), u < DETERMINED_SHARE * prior_u, seen & (u <= limit)))
