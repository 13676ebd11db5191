"""The band from which S is estimated, and the frequency at which it holds, are what several windows have in common."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.core.snapshot import pack, unpack
from benchmarks.online import lorries
from benchmarks.online.lorries import CALM_HZ, FAST_HZ, after, judged, take, window
from calib.model import BandSums
from calib.state.over_frequency import OverFrequency, common_band
from calib.windows.bands import beside_reference_noise, centre_hz, motion_band_hz
from calib.windows.record import WIDER, Record


def motion(record: Record) -> tuple[float, float]:
    """The band of its motion, which a record has."""
    assert record.motion_hz is not None
    return record.motion_hz


def calm(record: Record) -> Record:
    """What is left of a record in the band of the calm motion."""
    left = record.within(WIDER * CALM_HZ[1])
    assert left is not None
    return left


def test_motion_that_comes_and_goes_is_no_part_of_the_band_that_lasts() -> None:
    for kind, expected in ((".", CALM_HZ[1]), ("B", CALM_HZ[1]), ("W", FAST_HZ[1])):
        lasting = motion_band_hz([window(1, kind)], lasting=True)
        assert lasting is not None
        high_hz = lasting[1]
        assert expected * 0.95 < high_hz < expected * 1.15, kind
    blown = motion_band_hz([window(1, "B")])
    assert blown is not None
    assert blown[1] > 40.0


@pytest.mark.parametrize("wide", [1, 2, 3])
def test_three_wide_windows_of_eight_widen_nothing_in_any_order(wide: int) -> None:
    narrow, broad = (Record.of(window(1, fast), 0.0) for fast in (".", "W"))
    assert motion(broad)[1] > 3.0 * motion(narrow)[1]
    for order in set(permutations([broad] * wide + [narrow] * (4 - wide))):
        assert common_band(order)[:2] == narrow.motion_hz
    assert common_band([broad] * 7 + [narrow])[:2] == broad.motion_hz
    assert common_band([broad, replace(narrow, windows=3)])[:2] == narrow.motion_hz  # merged ones count as many


def test_the_frequency_is_one_that_windows_without_a_train_tell_too() -> None:
    """Two windows in which a train passes, with most motion at 6 Hz, settle it; then the band is that of the others.
    Before, S held at 10.2 Hz, which no window told, so that it was never determined."""
    narrow = replace(Record.of(window(1), 0.0), bands=None)
    train = [replace(narrow, motion_hz=(2.9, 36.0), mean_hz=hz) for hz in (6.3, 5.0)]
    others = [replace(narrow, motion_hz=(2.9, 6.8), mean_hz=3.4) for _ in range(6)]
    over, before, settled_hz = OverFrequency(), list[Record](), list[float]()
    for record in (*train, *others):
        over = over.begun(record, before)
        before.append(record)
        settled_hz.append(over.at_hz)
    assert over.motion_hz == (2.9, 6.8)
    assert settled_hz == [6.3, *[5.0] * 7]
    even = [replace(narrow, motion_hz=(2.0, 8.0), mean_hz=5.0) for _ in range(2)]  # motion of all frequencies alike
    assert OverFrequency().begun(even[0], []).begun(even[1], even[:1]).at_hz == 4.0


def test_the_centre_of_a_motion_is_where_most_of_it_is() -> None:
    """Bands of one width in the logarithm: 1 % of the power at 32 Hz beside the rest at 2 Hz."""
    low_hz = np.array([1.9, 30.0])
    products = np.array([np.eye(9) * power for power in (0.99, 0.01)])
    products[:, :3, 6:] = products[:, 6:, :3] = products[:, :3, :3]
    bands = BandSums(3, low_hz, low_hz * 1.1, np.full(2, 100.0), 1.0, products, np.zeros((2, 9)), np.ones(2))
    at_hz = np.sqrt(1.1) * low_hz
    np.testing.assert_allclose(centre_hz(bands, (1.0, 40.0)), at_hz[0] ** 0.99 * at_hz[1] ** 0.01, rtol=1e-9)
    np.testing.assert_allclose(centre_hz(bands, (1.0, 20.0)), at_hz[0], rtol=1e-9)
    assert centre_hz(bands, (5.0, 20.0)) == 0.0


def test_a_blow_that_reaches_down_to_nothing_is_no_lower_end() -> None:
    narrow = Record.of(window(1), 0.0)
    low_hz, high_hz = motion(narrow)
    assert common_band([replace(narrow, motion_hz=(0.02, 9.0)), narrow]) == (low_hz, 9.0, 2)
    assert common_band([replace(narrow, motion_hz=(20.0, 40.0)), narrow]) == (low_hz, high_hz, 2)


def test_the_lower_end_is_that_of_most_windows_where_more_than_an_octave_is_left() -> None:
    narrow = Record.of(window(1), 0.0)
    for most_hz, begins_hz in ((4.0, 4.0), (6.0, 1.0)):
        lows_hz = [1.0, *[most_hz] * 7]
        assert common_band([replace(narrow, motion_hz=(low_hz, 10.0)) for low_hz in lows_hz]) == (begins_hz, 10.0, 8)


def test_the_record_of_a_narrower_band_is_that_of_its_motion_alone() -> None:
    """The sensor's filter makes the faster motion smaller and later; below 12 Hz it is that of a pure delay."""
    wide = Record.of(window(3, "W"), 0.0)
    narrow = calm(wide)
    alone = Record.of(window(3), 0.0)  # the same motion below 12 Hz, without the faster one
    slopes = [np.linalg.solve(r.root, r.slopes)[:3].T for r in (wide, narrow, alone)]
    assert np.abs(slopes[0] - slopes[2]).max() > 0.02
    np.testing.assert_allclose(slopes[1], slopes[2], rtol=0, atol=5e-4)
    # The taper costs a tenth of the points, and what [u, du] cannot tell of the filter is not thinned by white noise.
    information = [r.root[0, 0] ** 2 * r.independent / r.noise[0] ** 2 for r in (narrow, alone)]
    assert 0.4 < information[0] / information[1] < 0.95
    assert replace(wide, bands=None).within(WIDER * CALM_HZ[1]) is None


def test_a_narrower_record_knows_the_present_certificate_of_the_reference() -> None:
    wide = Record.of(window(3, "W"), 0.0)
    one, other = (r.root for r in (
        calm(wide.with_reference_times(1.02)),
        calm(wide).with_reference_times(1.02),
    ))  # fmt: skip
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


def test_white_noise_of_the_reference_is_as_dense_in_a_narrower_band() -> None:
    rms = 1e-4
    white = np.outer([rms, rms * 2.0 * np.pi * 100.0 / np.sqrt(3.0)], np.ones(3))  # to half of the rate
    made = window(3, "W")
    assert made.bands is not None
    bands = beside_reference_noise(made.bands, white, made.points)
    narrow = calm(Record.of(replace(made, reference_noise=white, bands=bands), 0.0))
    assert narrow.reference_noise is not None
    assert narrow.bands is not None
    u, du = narrow.reference_noise
    np.testing.assert_allclose(u, rms, rtol=0.03)
    np.testing.assert_allclose(du, rms * 2.0 * np.pi * narrow.bands.high_hz[-1] / np.sqrt(3.0), rtol=0.03)


ORDERS = ["W...", ".W..", "WWW.", "BBB", ".BB"]


@pytest.mark.slow
@pytest.mark.parametrize("order", ORDERS)
def test_u_is_at_its_bound_whichever_windows_have_faster_motion(order: str) -> None:
    state = after([window(10 + k, kind) for k, kind in enumerate(order)])
    calm = after([window(10 + k) for k in range(len(order))])
    assert state.motion_to_hz < 1.2 * calm.motion_to_hz
    over_bound, over_u = judged(state)
    assert over_bound < 1.05
    assert over_u < 0.3  # the reference is right, and u is its own


@pytest.mark.slow
def test_the_frequency_is_settled_by_the_second_window_and_stays() -> None:
    state, found = after([]), list[float]()
    for k, kind in enumerate("W..WW"):
        take(state, window(20 + k, kind), k)
        found.append(state.reference_frequency_hz)
    assert found[0] > 1.5 * found[1]
    assert len(set(found[1:])) == 1
    state = after([window(20, "W"), window(21, "W")])
    settled_hz = state.reference_frequency_hz
    take(state, window(22), 2)
    assert state.motion_to_hz < 15.0
    assert state.reference_frequency_hz == settled_hz


def test_one_calm_window_does_not_narrow_the_band_of_eight() -> None:
    state = after([window(30, calm_hz=(0.5, 4.0)), *(window(30 + k) for k in range(1, 8))])
    assert state.motion_to_hz > 12.0
    narrow = after([window(30 + k, calm_hz=(0.5, 4.0)) for k in range(2)])
    assert narrow.motion_to_hz < 5.0


def test_what_was_settled_is_told() -> None:
    before = after([window(40 + k) for k in range(7)])
    then = before.copy()
    take(then, window(47), 7)
    told = then.settled_since(before)
    assert f"S holds at {then.reference_frequency_hz:.3g} Hz" in told
    assert "to 12" in told
    assert "8 windows have this band in common" in told
    assert "Set band_hz" in told
    last = then.copy()
    take(last, window(48), 8)
    assert last.settled_since(then) == ""
    first = after([window(40, "W")])
    second = first.copy()
    take(second, window(41), 1)
    assert "2 windows have this band in common, and may still change it" in second.settled_since(first)


@pytest.mark.slow
@pytest.mark.parametrize("cut", [1, 3])
def test_a_restored_state_settles_the_same(cut: int) -> None:
    windows = [window(50 + k, kind) for k, kind in enumerate("W..W.")]
    whole, first = after(windows), after(windows[:cut])
    again = after([])
    again.load(unpack(pack(first.snapshot())))
    for k, own in enumerate(windows[cut:], cut):
        take(again, own, k)
    assert pack(again.snapshot()) == pack(whole.snapshot())


def test_windows_with_faster_motion_whose_sums_by_band_are_no_longer_kept_are_left_out() -> None:
    held = after([window(60, "W")]).snapshot()
    held["records"][0]["bands"] = None  # as when windows are merged
    state = after([])
    state.load(unpack(pack(held)))
    loaded = state.copy()
    for k in range(1, 5):
        take(state, window(60 + k), k)
    assert state.motion_to_hz < 15.0
    assert judged(state)[0] < 1.05
    assert "1 older windows with motion above it are left out" in state.settled_since(loaded)


def test_a_stated_band_is_used_from_the_first_window_on_and_can_be_stated_later() -> None:
    windows = [window(70 + k, "W") for k in range(4)]
    stated, later = after(windows, CALM_HZ), after(windows)
    assert stated.motion_to_hz == WIDER * CALM_HZ[1]
    assert later.motion_to_hz > 50.0
    assert stated.reference_frequency_hz == pytest.approx(np.sqrt(CALM_HZ[0] * CALM_HZ[1]))
    state = after([], CALM_HZ)
    state.load(unpack(pack(later.snapshot())))
    loaded = state.copy()
    assert state.restate()
    assert "this band is stated" in state.settled_since(loaded)
    assert state.motion_to_hz == stated.motion_to_hz
    assert state.reference_frequency_hz == later.reference_frequency_hz  # it was settled
    for found in (stated, state):
        assert judged(found)[0] < 1.05


@pytest.mark.thorough
def test_lorries_in_the_first_window_do_not_matter_on_line() -> None:
    """With the band of the first window for life, u was 1.26 times the bound with these samples."""
    found = lorries.one(("the first", lorries.SEED + 2))
    assert found.status == "VALID"
    assert found.held == 0
    assert (found.u_pct < 1.05 * lorries.BOUND_PCT).all()
    assert (np.abs(found.over_u) < 3.0).all()
    assert len(found.frequencies_hz) <= 2


@pytest.mark.parametrize(
    ("stated", "told"),
    [
        ("[12.0, 0.5]", "state the lower frequency first"),
        ("[5.0, 7.0]", "at least 2 times as high"),
        ("[0.5, 40.0]", "40 Hz is above 30 Hz, up to which s tells the motion with rate_hz 100"),
        ("[0.5]", "band_hz"),
        ("[3.0, 12.0]", "prior.reference_frequency_hz 2 is not within band_hz [3, 12]"),
        ("[0.5, 12.0]", ""),
    ],
)
def test_a_stated_band_is_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str], stated: str, told: str) -> None:
    device = ["[[devices]]", 'driver = "serial-csv"']
    lines = [*device, 'name = "s"', 'options = { port = "/dev/s", rate_hz = 100 }']
    lines += [*device, 'name = "r"', 'options = { port = "/dev/r", rate_hz = 100 }']
    lines += ["[[channels]]", 'sensor = "s"', 'reference = "r"', "rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]"]
    lines += [f"band_hz = {stated}", "[channels.prior]", "sensitivity = 1.0", "reference_frequency_hz = 2.0"]
    path = tmp_path / "site.toml"
    path.write_text("\n".join(lines) + "\n")
    status = run_cli(["check", str(path)])
    said = capsys.readouterr()
    assert status == (2 if told else 0)
    assert told in said.err + said.out
