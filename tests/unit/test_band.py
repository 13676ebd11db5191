"""Band of the motion, the filter that limits sensor and reference to it, and the lag that only then can be seen."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.cli.simulate import write_files
from calib.excitation.band_to_keep import FILTER_BANDS
from calib.signal.band import band_above_noise, lowpass, lowpass_lost
from hw.virtual.bench import Bench
from hw.virtual.motion import ambient
from hw.virtual.parameters import BenchParameters, ReferenceParameters, SensorParameters
from hw.virtual.schedule import Schedule, directed
from hw.virtual.timebase import Clock

RATE_HZ, BAND_HZ = 200.0, 12.0
S_TRUE = np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.005], [-0.01, 0.02, 1.01]])


@pytest.mark.parametrize(
    ("frequency_hz", "least", "most"), [(0.5, 0.999, 1.001), (12.0, 0.999, 1.001), (18.5, 0.0, 2e-3)]
)
def test_the_filter_passes_the_band_and_stops_the_rest(frequency_hz: float, least: float, most: float) -> None:
    t = np.arange(4000) / RATE_HZ
    x = np.column_stack([np.sin(2 * np.pi * frequency_hz * t), np.cos(2 * np.pi * frequency_hz * t)])
    out = lowpass(x, RATE_HZ, BAND_HZ)
    inside = np.isfinite(out).all(axis=1)
    assert (~inside).sum() == 2 * lowpass_lost(RATE_HZ, BAND_HZ)
    size = np.hypot(*out[inside].T)
    assert least <= size.min()
    assert size.max() <= most
    if least:  # no phase
        np.testing.assert_allclose(out[inside], x[inside], atol=1e-3)


def test_a_missing_sample_takes_its_neighbourhood_with_it() -> None:
    x = np.random.default_rng(1).normal(size=(600, 2))
    lost = lowpass_lost(RATE_HZ, BAND_HZ)
    whole = lowpass(x, RATE_HZ, BAND_HZ)
    x[300, 0] = np.nan
    out = lowpass(x, RATE_HZ, BAND_HZ)
    missing = np.flatnonzero(np.isnan(out[lost:-lost, 0])) + lost
    assert (missing[0], missing[-1]) == (300 - lost, 300 + lost)
    kept = np.isfinite(out).all(axis=1)
    np.testing.assert_allclose(out[kept], whole[kept], atol=1e-12)


@pytest.mark.parametrize("n", [1009, 1024, 1500])
def test_it_is_a_filter_whatever_the_length(n: int) -> None:
    """Linear and unmoved by time: a pulse gives its taps, wherever it stands, and they sum to one."""
    half = lowpass_lost(200.0, 10.0)
    pulse = np.zeros((n, 2))
    pulse[500, 0] = pulse[510, 1] = 1.0
    shown = lowpass(pulse, 200.0, 10.0)
    taps = shown[500 - half : 501 + half, 0]
    assert np.abs(taps - shown[510 - half : 511 + half, 1]).max() < 1e-15
    assert np.abs(taps - taps[::-1]).max() < 1e-15
    assert taps.sum() == pytest.approx(1.0, abs=1e-12)
    assert np.isnan(shown[:half]).all()
    assert np.isnan(shown[-half:]).all()
    assert np.isfinite(shown[half:-half]).all()


@pytest.mark.thorough
def test_a_lag_is_found_under_the_noise_of_the_reference(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Rms 0.02 m/s2 and noise 0.006: in all of its band the reference's derivative is noise, 3 ms then cost 0.6 %."""
    up = np.array([0.0, 0.0, 9.80665])
    stands = tuple(directed(np.array([1.0, 0.0, 0.0]), up, 29.5, level) for level in (1.0, 0.15))
    sensor = SensorParameters(sensitivity=S_TRUE, noise_mps2=0.002, clock=Clock(100.0), lag_s=(3e-3, 3e-3, 3e-3))
    reference = ReferenceParameters(rotation=np.eye(3), noise=0.006, clock=Clock(100.0, offset_s=1.7e-3))
    motion = ambient(np.random.default_rng(3))
    bench = Bench(BenchParameters(Schedule(stands, turn_s=0.5), motion, sensor, reference), 3)
    write_files(bench, tmp_path, 420.0, {})
    capsys.readouterr()
    files = ["--sensor", str(tmp_path / "sensor.csv"), "--reference", str(tmp_path / "reference.csv")]
    priors = ["--u-rotation-deg", "0", "--u-reference-pct", "0"]
    assert run_cli(["calibrate", *files, "--rotation", "1,0,0,0,1,0,0,0,1", *priors, "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    u_lag_s = found["nuisances"]["lag"]["standard_uncertainty"]  # larger than 0.1 ms: the response has a phase too
    assert found["lag_s"] == pytest.approx(3e-3, abs=3.0 * u_lag_s)
    assert u_lag_s < 0.3e-3
    u = np.array(found["standard_uncertainty"]["sensitivity"])
    assert np.abs((np.array(found["sensitivity"]) - S_TRUE) / u).max() < 3.5  # of nine
    assert u.max() < 5e-3


@pytest.mark.parametrize(("run", "every"), [(1, 20), (1, 100), (2, 50), (16, 320), (16, 640), (200, 4000)])
def test_holes_are_no_noise(run: int, every: int) -> None:
    """Up to a twentieth of the samples missing: the noise found is that of the whole.

    To 20 % of its power, and 7e-4 of the motion's, which straight lines over pairs of samples leave: so much, taken for
    noise, moves S by 7e-4, less than a reference of 0.1 %.
    """
    random = np.random.default_rng(1)
    n, rate_hz, noise_mps2 = 6000, 100.0, 0.001
    shape = np.fft.rfftfreq(n, 1 / rate_hz) < 8.0
    motion = np.fft.irfft(shape * (random.normal(size=(len(shape), 2)) @ [1, 1j]), n)
    x = (0.1 * motion / motion.std() + noise_mps2 * random.normal(size=n))[:, None]
    for first in range(every // 2, n, every):
        x[first : first + run] = np.nan
    band_hz, density = band_above_noise(x, rate_hz)
    assert band_hz is not None
    assert 8.0 <= band_hz < 18.0  # lines are 0.8 Hz apart where holes leave short segments only
    assert abs(density[0] ** 2 * 0.5 * rate_hz - noise_mps2**2) < 0.2 * noise_mps2**2 + 7e-4 * 0.1**2


@pytest.mark.parametrize("order", range(len(FILTER_BANDS)))
def test_noise_that_was_differentiated_is_mostly_in_the_filters_edge(order: int) -> None:
    """White noise, differentiated so often, and limited: its power is that up to the equivalent bandwidth, to 1.5 %,
    for bands from 1/40 to 1/6 of the rate. The bandwidth for white noise alone takes 4 % off after two."""
    for band_hz in (5.0, 10.0, 33.0):
        pulse = np.zeros((20_001, 1))
        pulse[len(pulse) // 2] = 1.0
        gain = np.abs(np.fft.rfft(np.nan_to_num(lowpass(pulse, 200.0, band_hz)[:, 0])))
        hz = np.fft.rfftfreq(len(pulse), 1.0 / 200.0)
        power = np.sum(hz ** (2 * order) * gain**2) * hz[1]
        limit_hz = FILTER_BANDS[order] * band_hz
        assert power == pytest.approx(limit_hz ** (2 * order + 1) / (2 * order + 1), rel=0.015)
