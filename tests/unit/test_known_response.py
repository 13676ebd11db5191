"""Known filters of sensor and reference are divided out: S is right, and better known than without the statement."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import remez

from agent.cli.main import run_cli
from calib import InputError, calibrate
from calib.distributions import chi2_quantile
from calib.estimate.nuisances import Priors
from calib.recorded.adjusting import adjusted
from calib.recorded.outcome import Outcome
from calib.signal.known_response import UNKNOWN, KnownResponse, known_response_of
from tests.pair import Filter, Pair, decimator, lowpass, moving_mean, pair

EXACT: dict[str, Any] = {"reference": 1e-9, "rotation_rad": 1e-9, "lag_axis_s": 1e-9}
MOTION_HZ = (0.5, 20.0)
U_CORNER = 0.1


def recorded(
    seed: int, response: Filter, known: KnownResponse, *, in_reference: bool = False, noise_mps2: float = 0.01,
    seconds: float = 60.0, u_reference: float = 1e-9, error: float = 0.0, band_hz: tuple[float, float] | None = None,
) -> tuple[Pair, Outcome]:  # fmt: skip
    """With the filter in the reference, `pair` gives S over what the reference shows."""
    acts: Filter = (lambda f: 1.0 / response(f)) if in_reference else response
    made = pair(
        seed, acts, band_hz=MOTION_HZ, rate_hz=200.0, seconds=seconds, known=known, noise_mps2=noise_mps2,
        reference_error=error,
    )  # fmt: skip
    stated = Priors(**(EXACT | {"reference": u_reference, "reference_frequency_hz": made.reference_frequency_hz}))
    return made, adjusted(made.files, stated.beside_known(known), band_hz=band_hz)


def relative(made: Pair, found: Outcome, response: Filter | None = None) -> tuple[float, float]:
    """Relative error and standard uncertainty of S_xx; `response`: the one that is in the reference."""
    assert found.calibration is not None, found.reasons
    true = made.sensitivity[0, 0]
    if response is not None:
        true = true * abs(response(np.array([made.reference_frequency_hz]))[0])
    u = found.calibration.standard_uncertainty[0]
    return float(found.calibration.sensitivity[0, 0] / true - 1.0), float(u / true)


def drawn(seed: int, order: int, corner_hz: float) -> Filter:
    """A low-pass filter whose corner differs from what is stated by its uncertainty of 10 %."""
    return lowpass(order, corner_hz * (1.0 + U_CORNER * np.random.default_rng([13, seed]).normal()))


@pytest.mark.two_cases
@pytest.mark.parametrize("in_reference", [False, True])
@pytest.mark.parametrize("order", [2, 4])
def test_a_stated_filter_of_which_the_corner_is_a_tenth_off(order: int, in_reference: bool) -> None:
    """What is left is small: it is found with less uncertainty than a filter of which nothing is stated."""
    line, response = f"lowpass order={order} corner_hz=31", drawn(1, order, 31.0)
    known = known_response_of(["flat"], [line]) if in_reference else known_response_of([line], ["flat"])
    made, found = recorded(1, response, known, in_reference=in_reference, noise_mps2=0.3)
    error, u = relative(made, found, response if in_reference else None)
    assert abs(error) < 2.0 * u
    _, without = recorded(1, response, UNKNOWN, in_reference=in_reference, noise_mps2=0.3)
    at_0hz, unknown = (r.more["sensitivity_at_0hz"]["standard_uncertainty"][0, 0] for r in (found, without))
    assert at_0hz < 0.9 * unknown
    assert found.lag_s == pytest.approx(without.lag_s, abs=2e-4)


@pytest.mark.thorough
def test_a_filter_whose_corner_is_within_the_motion_is_right_only_if_it_is_stated() -> None:
    response, known = lowpass(4, 16.1), known_response_of(["lowpass order=4 corner_hz=16 u_corner_pct=1"], ["flat"])
    made, found = recorded(2, response, known)
    error, u = relative(made, found)
    assert abs(error) < 2.0 * u < 5e-3
    _, without = recorded(2, response, UNKNOWN, band_hz=(0.0, MOTION_HZ[1]))
    assert without.calibration is None or without.calibration.standard_uncertainty[0] > 5.0 * u


def test_a_corner_that_is_hardly_known_within_the_motion_determines_nothing() -> None:
    _, found = recorded(
        2, lowpass(4, 16.0), known_response_of(["lowpass order=4 corner_hz=16 u_corner_pct=20"], ["flat"])
    )
    (reason,) = found.reasons
    assert reason.startswith("rank 3 of 4: the data determine none of the 12 parameters")


@pytest.mark.parametrize("side", ["sensor", "reference"])
def test_decimators_by_their_taps_and_means(side: str) -> None:
    taps = remez(63, [0.0, 24.0, 38.4, 96.0], [1.0, 0.0], weight=[1, 10], fs=192.0)
    line = f"fir rate_hz=192 taps={','.join(map(repr, taps.tolist()))} ripple_pct=0.02"
    response: Filter = lambda f: decimator(24.0)(f) / taps.sum() * moving_mean(0.01)(f)  # noqa: E731
    lines = [line, "mean points=1000 rate_hz=100000"]
    known = known_response_of(lines, ["flat"]) if side == "sensor" else known_response_of(["flat"], lines)
    made, found = recorded(3, response, known, in_reference=side == "reference")
    error, u = relative(made, found, response if side == "reference" else None)
    assert abs(error) < 2.0 * u < 1.5e-3
    assert abs(found.lag_s or 0.0) == pytest.approx(31.0 / 192.0 + 0.005, abs=2e-4)


def test_the_response_of_the_sensor_is_told_with_its_filter_and_without_that_of_the_reference() -> None:
    of_sensor, of_reference = lowpass(2, 31.0), lowpass(1, 40.0)
    known = known_response_of(["lowpass order=2 corner_hz=31 u_corner_pct=1"], ["lowpass corner_hz=40 u_corner_pct=1"])
    made, found = recorded(4, lambda f: of_sensor(f) / of_reference(f), known)
    at_hz = np.array([made.reference_frequency_hz])
    gain = made.sensitivity[0, 0] / abs(of_sensor(at_hz) / of_reference(at_hz))[0]
    for band in found.more["response"]:
        middle_hz = np.array([np.sqrt(band["low_hz"] * band["high_hz"])])
        told = abs(band["sensitivity_re"][0, 0] + 1j * band["sensitivity_im"][0, 0])
        u = max(band["standard_uncertainty"][0, 0], 5e-4)
        assert told == pytest.approx(gain * abs(of_sensor(middle_hz))[0], abs=3.0 * u)
    assert found.more["sensitivity_at_0hz"]["sensitivity"][0, 0] == pytest.approx(gain, rel=1e-3)


@pytest.mark.slow
def test_coverage_with_corners_drawn_from_their_uncertainty() -> None:
    """The reference's error is drawn as well. benchmarks.response has more."""
    runs, squares = 12, 0.0
    for seed in range(200, 200 + runs):
        random = np.random.default_rng([17, seed])
        order, corner_hz = int(random.choice([1, 2, 4])), float(random.choice([26.0, 31.0, 60.0]))
        known = known_response_of([f"lowpass order={order} corner_hz={corner_hz}"], ["flat"])
        response = lowpass(order, corner_hz * (1.0 + U_CORNER * float(random.normal())))
        made, found = recorded(
            seed, response, known, u_reference=2e-4, error=2e-4 * float(random.normal()), seconds=40.0
        )
        error, u = relative(made, found)
        squares += (error / u) ** 2
    assert squares < chi2_quantile(0.999, runs)  # a variance 1.5 times as large is seen


# --- as users state it


def written(folder: Path, made: Pair, seconds: float) -> list[str]:
    """The files of a pair, as options of the command."""
    streams = {"sensor": (made.files._sensor, "vx,vy,vz"), "reference": (made.files._reference, "ax,ay,az")}
    options = []
    for name, (stream, columns) in streams.items():
        assert stream is not None
        cut = stream.cut(0.0, seconds)
        assert cut is not None
        rows = np.column_stack([cut.time_s, cut.values])
        np.savetxt(folder / f"{name}.csv", rows, delimiter=",", header=f"time_s,{columns}", comments="", fmt="%.9g")
        options.append(f"--{name}={folder / name}.csv")
    return [*options, "--rotation=1,0,0,0,1,0,0,0,1", "--u-rotation-deg=0.0001", "--reference-coupling=ac"]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], Pair, Filter]:
    """A reference with a low-pass filter, as its certificate has it in a table; the sensor is flat."""
    folder, response = tmp_path_factory.mktemp("files"), lowpass(2, 40.0)
    made = pair(5, lambda f: 1.0 / response(f), band_hz=MOTION_HZ, rate_hz=200.0, seconds=60.0)
    return written(folder, made, 60.0), made, response


def certificate(folder: Path, response: Filter, **changed: object) -> Path:
    rows_hz = np.array([0.5, 1.0, 2.0, 4.0, 6.3, 8.0, 10.0, 12.5, 16.0, 20.0, 25.0, 31.5])
    h = response(rows_hz)
    table = {
        "frequency_hz": rows_hz.tolist(), "relative_sensitivity": np.abs(h).tolist(),
        "phase_deg": np.degrees(np.unwrap(np.angle(h))).tolist(), "expanded_u_pct": [0.1] * len(rows_hz),
    }  # fmt: skip
    lines = [f"{name} = {value}" for name, value in (table | changed).items()]
    path = folder / "certificate.toml"
    path.write_text("\n".join(["[certificate]", "u_sensitivity_pct = 0.05", "[certificate.response]", *lines, ""]))
    return path


def calibrated(*options: str, to: Path) -> dict[str, Any]:
    run_cli(["calibrate", *options, f"--json={to}"])
    return dict(json.loads(to.read_text()))


@pytest.mark.slow
def test_the_table_of_a_certificate(files: tuple[list[str], Pair, Filter], tmp_path: Path) -> None:
    options, made, response = files
    path = certificate(tmp_path, response)
    told = calibrated(*options, f"--reference-certificate={path}", "--sensor-filter=flat", to=tmp_path / "a.json")
    true = made.sensitivity[0, 0] * abs(response(np.array([made.reference_frequency_hz]))[0])
    u = told["standard_uncertainty"]["sensitivity"][0][0]
    assert abs(told["sensitivity"][0][0] - true) < 2.0 * u < 3e-3
    assert told["valid_band_hz"][1] > 10.0
    assert told["options"]["sensor_filter"] == ["flat"]
    without = calibrated(*options, to=tmp_path / "b.json")
    assert without["valid_band_hz"][1] < told["valid_band_hz"][1]


@pytest.mark.slow
def test_options_win_over_the_certificate(files: tuple[list[str], Pair, Filter], tmp_path: Path) -> None:
    options = files[0]
    path = certificate(tmp_path, lambda f: np.ones(len(f)) + 0j)
    line = "lowpass order=2 corner_hz=40"
    both = [f"--reference-certificate={path}", f"--reference-filter={line}", "--sensor-filter=flat"]
    told = calibrated(*options, *both, to=tmp_path / "a.json")
    alone = calibrated(*options, *both[1:], "--u-reference-pct=0.05", to=tmp_path / "b.json")
    assert told["sensitivity"] == alone["sensitivity"]


@pytest.mark.parametrize(("changed", "told"), [
    ({"relative_sensitivity": [1.0]}, "relative_sensitivity: 1 values, but frequency_hz has 12; give one for each"),
    ({"frequency_hz": [2.0, 1.0] * 6}, "frequency_hz: must be above 0 and increase"),
    ({"phase": [0.0]}, "phase"),
])  # fmt: skip
def test_a_fault_of_the_table_is_told(
    files: tuple[list[str], Pair, Filter], tmp_path: Path, capsys: pytest.CaptureFixture[str],
    changed: dict[str, object], told: str,
) -> None:  # fmt: skip
    path = certificate(tmp_path, lowpass(2, 40.0), **changed)
    assert run_cli(["calibrate", *files[0], f"--reference-certificate={path}"]) == 2
    said = capsys.readouterr().err
    assert told in said
    assert "certificate.toml:" in said
    assert "Traceback" not in said


def test_a_fault_of_an_option_is_told(
    files: tuple[list[str], Pair, Filter], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_cli(["calibrate", *files[0], "--sensor-filter=lowpass order=2"]) == 2
    said = capsys.readouterr().err
    assert "sensor_filter" in said
    assert "lowpass needs corner_hz=..." in said
    assert run_cli(["calibrate", *files[0], "--sensor-filter=flat", "--plain"]) == 2
    assert "Method 3" in capsys.readouterr().err


def test_from_python() -> None:
    nothing = {"time_s": [0.0, 1.0], "vx": [0.0, 0.0], "vy": [0.0, 0.0], "vz": [0.0, 0.0]}
    with pytest.raises(InputError, match=r"sensor_filter.*'low' is no kind of filter"):
        calibrate(nothing, sensor_filter="low order=2")
