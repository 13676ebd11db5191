"""Records of windows that are drawn from the model of an estimate itself, without samples: years of them in seconds.

What is stated is true here. So these records show what merging of old records, gaps and the smoothed past do to U; that
the model is that of a sensor is shown elsewhere (tests/unit/test_physics.py, tests/properties/test_uncertainty.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from calib.estimate.estimate import Estimate
from calib.estimate.physics import Stack, Windows
from calib.estimate.statements import Statements
from calib.estimate.unknowns import Unknowns
from calib.model import Array
from calib.windows.record import Record
from tests.building_windows import building_window
from tests.drawn_records import scatter

LAG_LEFT_S = 2e-5  # what a front end leaves of the lag


def templates(count: int, seed: int = 1) -> list[Record]:
    """Windows of a minute in all directions, with levels between 0.02 and 0.3 m/s2."""
    random = np.random.default_rng(seed)
    levels = np.exp(random.uniform(np.log(0.02), np.log(0.3), size=(count, 3)))
    made = (building_window(random, level_mps2=tuple(level)) for level in levels)
    return [replace(Record.of(window, 0.0), scores=scatter(1.0, 60.0)) for window in made]


def drawn(
    random: np.random.Generator,
    own: Sequence[Record],
    days: Array,
    statements: Statements,
    *,
    temperature: Callable[[float], float],
    reference: Callable[[float], str] = lambda _: "A",
) -> tuple[list[Record], Array]:
    """Records on these days (W,), each with one of the templates, and S and Q of then (W, 12)."""
    records = []
    for day, k in zip(days.tolist(), random.integers(0, len(own), len(days)).tolist(), strict=True):
        t = temperature(day)
        over_t = np.array([[1.0, t, t * t]])
        records.append(
            replace(own[k], day=day, days=(day, day), temperature_degc=t, over_t=over_t, reference=reference(day))
        )
    unknowns = Unknowns(statements, records)
    mean, u = unknowns.prior
    x = mean + np.where(u < 100.0, u, 0.0) * random.standard_normal(len(mean))
    for key, k in unknowns.at.items():
        if key.startswith("lag"):
            x[k] = LAG_LEFT_S * random.standard_normal()
    truth, made, before = np.zeros((len(days), 12)), [], days[0]
    for w, (record, day) in enumerate(zip(records, days.tolist(), strict=True)):
        if day > before:
            follows, shift, passage = unknowns.passage(before, day)
            x = follows @ x + shift + passage.noise @ random.standard_normal(passage.noise.shape[1])
        before, truth[w] = day, x[:12]
        made.append(_told(random, record, unknowns, x))
    return made, truth


def _told(random: np.random.Generator, record: Record, unknowns: Unknowns, x: Array) -> Record:
    s, priors = unknowns.statements, unknowns.statements.of(record.reference)
    told = {"share": priors.reference_share, "known_size": priors.known_size}
    stack, degc = Stack.of([record], fixed=s.held_mps2 is not None), s.temperature.reference_degc
    windows = Windows(stack, degc, s.nominal, s.held_mps2, at_hz=priors.reference_frequency_hz, **told)
    effect, taken_out = unknowns.effect(record, record.day)
    slopes, means = windows.predicted((effect @ (x - taken_out))[None])
    white = np.sqrt(1.0 / record.independent)
    slopes = slopes[0] + white * record.noise * random.standard_normal(slopes[0].shape) * (
        np.diag(record.root)[:, None] > 0.0
    )
    late = max(priors.lag_window_s, record.u_lag_s) * random.standard_normal()
    slopes = slopes + late * record.loadings[0].reshape(-1, 3) * record.noise
    scatter = np.hypot(white * record.noise / np.sqrt(record.count), priors.offset_mps2 * s.scale)
    return replace(record, slopes=slopes, means=means[0] + scatter * random.standard_normal((1, 3)))


def smoothed(found: Estimate) -> tuple[Array, Array, Array]:
    """Days (K,) of the epochs with a window, S and Q (K, 12) by all windows, and their standard uncertainties."""
    seen = set(found.epoch_of.tolist())
    past = [own for k, own in enumerate(list(found.past())[::-1]) if k in seen]
    days = np.array([own.now.day for own in past])
    values, variance = (np.array([getattr(own.now, name)[:12] for own in past]) for name in ("mean", "variance"))
    return days, values, np.sqrt(variance)
