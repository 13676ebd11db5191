"""What the filters of an instrument make of a motion, over frequency in Hz: from taps and poles, not as stated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Response = Callable[[Array], ComplexArray]


def in_turn(*responses: Response) -> Response:
    """One filter after the other."""

    def response(frequency_hz: Array) -> ComplexArray:
        return np.asarray(np.prod([one(frequency_hz) for one in responses], axis=0))

    return response


def taps(weights: Array, rate_hz: float) -> Response:
    """A filter by its taps at a rate; their sum counts as 1."""

    def response(frequency_hz: Array) -> ComplexArray:
        phase = -2j * np.pi / rate_hz * np.multiply.outer(frequency_hz, np.arange(len(weights)))
        return np.asarray(np.exp(phase) @ (weights / weights.sum()))

    return response


def lowpass(order: int, corner_hz: float) -> Response:
    """A Butterworth filter of first or second order."""

    def response(frequency_hz: Array) -> ComplexArray:
        s = 1j * frequency_hz / corner_hz
        return np.asarray(1.0 / (1.0 + s if order == 1 else 1.0 + np.sqrt(2.0) * s + s**2))

    return response


def delay(late_s: float) -> Response:
    """A pure delay."""

    def response(frequency_hz: Array) -> ComplexArray:
        return np.asarray(np.exp(-2j * np.pi * frequency_hz * late_s))

    return response
