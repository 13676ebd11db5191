"""Mistakes that users make: each is told with its cause and with what to do, and what it says to do is accepted."""

from __future__ import annotations

import itertools
import json
from functools import cache

import numpy as np
import pytest

from calib.adjustment.mistakes import with_unit
from calib.recorded.errors import InputError, OptionError
from calib.recorded.measurement_result import NuisanceValue
from calib.recorded.notebook import calibrate
from calib.recorded.outcome import Outcome
from calib.recorded.table import ReferenceTable
from calib.recorded.wrong_unit import check_gravity, gravity_warnings, measures_gravity
from tests.clamp_windows import frame

Table = tuple[np.ndarray, np.ndarray]  # times in s and values
G_MPS2 = 9.80665
RATE_HZ = 100.0
S_TRUE = 26.0 * np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.005], [-0.01, 0.02, 1.01]])
Q_TRUE = np.array([9.0, -4.0, 14.0])
STRAIGHT = np.eye(3)
FACES = [sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
EDGES = [np.array(v) / np.sqrt(2.0) for v in itertools.product((1.0, 0.0, -1.0), repeat=3) if np.count_nonzero(v) == 2]


def rests(ups: list[np.ndarray], seed: int = 1) -> tuple[Table, list[dict[str, float]]]:
    """A sensor that rests for 6 s with each of these directions up, and is turned in 1 s; and the poses."""
    random = np.random.default_rng(seed)
    way = np.linspace(0.0, 1.0, int(RATE_HZ))[:, None]
    parts, poses, at_s = [], [], 0.0
    for up, after in zip(ups, [*ups[1:], ups[0]], strict=True):
        turned = up + way * (after + 0.1 * random.normal(size=3) - up)
        parts += [np.tile(up, (6 * len(way), 1)), turned / np.linalg.norm(turned, axis=1, keepdims=True)]
        gravity = dict(zip(("gx", "gy", "gz"), G_MPS2 * up, strict=True))
        poses.append({"start_s": at_s, "stop_s": at_s + 6.0, **gravity})
        at_s += 7.0
    a = G_MPS2 * np.concatenate(parts)
    V = a @ S_TRUE.T + Q_TRUE + 0.1 * random.normal(size=a.shape)
    return (np.arange(len(V)) / RATE_HZ, V), poses


def right(found: Outcome) -> None:
    """Valid, and each parameter within its U of the truth."""
    assert found.reasons == ()
    away = np.abs(found.values - np.append(S_TRUE.ravel(), Q_TRUE))
    known = np.isfinite(found.values)
    assert known.any()
    assert (away[known] <= 1.5 * found.expanded_uncertainty[known] + 1e-9).all()


def only_reason(found: Outcome) -> str:
    assert found.status == "refused"
    assert len(found.reasons) == 1, found.reasons
    return found.reasons[0]


def test_six_rests_without_poses_ask_for_them() -> None:
    sensor, poses = rests(FACES)
    reason = only_reason(calibrate(sensor))
    assert "10 rests are needed, and 6 were found" in reason
    assert "`poses` (start_s,stop_s,gx,gy,gz)" in reason
    assert "edges" in reason
    right(calibrate(sensor, poses=poses))


def test_faces_twice_ask_for_edges_and_not_for_faces() -> None:
    sensor, poses = rests([*FACES, *FACES])
    reason = only_reason(calibrate(sensor))
    assert "the positions of the 12 rests do not determine all 9 parameters" in reason
    assert "up and down" not in reason
    assert "edges" in reason
    right(calibrate(sensor, poses=poses))
    assert calibrate(rests([*FACES, *EDGES])[0]).reasons == ()


def triad(
    S: np.ndarray = S_TRUE, seconds: float = 40.0, seed: int = 3, turn: np.ndarray = STRAIGHT
) -> tuple[Table, Table]:
    """A sensor beside a DC-coupled triad, a = turn a_ref, moved in all directions and leaned by some degrees."""
    random = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    a = np.zeros((len(t), 3))
    for axis in range(3):
        for frequency_hz in random.uniform(0.5, 6.0, 25):
            a[:, axis] += 0.6 * np.sin(2.0 * np.pi * frequency_hz * t + random.uniform(0.0, 2.0 * np.pi))
    lean = 0.3 * np.column_stack([np.sin(2 * np.pi * 0.11 * t), np.cos(2 * np.pi * 0.07 * t)])
    up = np.column_stack([lean, np.ones(len(t))])
    a += G_MPS2 * up / np.linalg.norm(up, axis=1, keepdims=True)
    V = a @ S.T + Q_TRUE + 0.1 * random.normal(size=a.shape)
    return (t, V), (t, a @ turn + 0.002 * random.normal(size=a.shape))


def beside(sensor: object, reference: object, **options: object) -> Outcome:
    return calibrate(sensor, reference, **{"rotation": np.eye(3), **options})


@cache
def sound() -> Outcome:
    """What is found beside the triad where nothing is wrong."""
    return beside(*triad())


@cache
def of_twenty_seconds() -> Outcome:
    """The same of half as long."""
    return beside(*triad(seconds=20.0))


def test_a_sound_triad_has_no_warning() -> None:
    right(sound())
    assert sound().warnings == ()


def test_sensor_and_reference_exchanged_are_refused_by_the_size_of_gravity() -> None:
    sensor, reference = triad(10.0 * S_TRUE)
    told = r"\(26\d g\): another unit, or `sensor` and `reference` are exchanged; exchange them"
    with pytest.raises(InputError, match=told):
        beside(reference, sensor)
    assert beside(sensor, reference).reasons == ()


@pytest.mark.parametrize(
    ("factor", "unit"), [(1 / G_MPS2, "g"), (1000 / G_MPS2, "mg"), (100.0, "cm/s2"), (1e3, "mm/s2")]
)
def test_a_reference_in_another_unit_is_told_the_unit(factor: float, unit: str) -> None:
    sensor, (t, a) = triad()
    with pytest.raises(InputError, match=f"convert them from {unit} to m/s2"):
        beside(sensor, (t, factor * a))


@pytest.mark.parametrize("length", [0.88, 0.92, 1.1])
def test_a_reference_in_g_with_a_large_offset_is_none_that_does_not_feel_gravity(length: float) -> None:
    """As drivers of lidars and cameras publish it in messages for m/s2."""
    sensor, (t, a) = triad()
    with pytest.raises(InputError, match="convert them from g to m/s2"):
        beside(sensor, (t, a * length / G_MPS2))


@pytest.mark.parametrize("factor", [G_MPS2, 0.3048, 1e6, 1.08])
def test_a_reference_whose_mean_is_not_gravity_is_refused(factor: float) -> None:
    sensor, (t, a) = triad()
    with pytest.raises(InputError, match="another unit, or"):
        beside(sensor, (t, factor * a))


@pytest.mark.parametrize("rms_mps2", [0.1, 3.0, 8.0])
@pytest.mark.parametrize("hz", [0.3, 3.0, 30.0])
def test_strong_motion_and_turning_are_no_other_unit(rms_mps2: float, hz: float) -> None:
    """The mean over some samples is gravity at strong fast motion, that over few ones where the sensor is turned."""
    t = np.arange(12_000) / RATE_HZ
    shaken = np.sqrt(2.0) * rms_mps2 * np.sin(2.0 * np.pi * hz * t)
    felt = np.column_stack([shaken, 0.0 * t, G_MPS2 + 0.0 * t])
    check_gravity(ReferenceTable("reference", t, felt, "acceleration", "ax"))
    turned = G_MPS2 * np.column_stack([np.sin(0.9 * t), np.cos(0.9 * t), 0.0 * t])
    check_gravity(
        ReferenceTable("reference", t, turned + 0.1 * rms_mps2 * shaken[:, None] / 30.0, "acceleration", "ax")
    )
    not_felt = np.column_stack([shaken, shaken, shaken])
    check_gravity(ReferenceTable("reference", t, not_felt, "acceleration", "ax"))


def test_a_reference_that_does_not_feel_gravity_tells_no_offset() -> None:
    """A seismometer, an IEPE one with three axes, or a file whose means were taken out: the sensor's mean contains
    gravity, which would be taken for Q."""
    sensor, (t, a) = triad(seconds=20.0)
    lines = np.fft.rfft(a, axis=0)
    lines[np.fft.rfftfreq(len(t), 1.0 / RATE_HZ) < 0.4] = 0.0  # means and leans
    moved = np.fft.irfft(lines, len(t), axis=0)
    found = beside(sensor, (t, moved))
    assert found.status == "valid"
    assert np.isnan(found.offset).all()
    assert np.isfinite(found.sensitivity).all()
    stated = beside(sensor, (t, moved), reference_coupling="dc")
    assert np.isfinite(stated.offset).all()


def test_which_references_feel_gravity() -> None:
    t = np.arange(12_000) / RATE_HZ
    shaken = 4.0 * np.sin(2.0 * np.pi * 3.0 * t)[:, None] * np.ones(3)
    turned = G_MPS2 * np.column_stack([np.sin(0.9 * t), np.cos(0.9 * t), 0.0 * t])
    feels = {
        "shaken and turned": (shaken + turned, True),
        "shaken": (shaken, False),
        "one axis": (turned[:, :1], False),
    }
    for told, (x, expected) in feels.items():
        assert measures_gravity(ReferenceTable("reference", t, x, "acceleration", "ax")) is expected, told
    assert not measures_gravity(ReferenceTable("reference", t, turned, "velocity", "vx"))
    # 1 in the unit g, which nobody stated, is refused as such (check_gravity); stated m/s2 is an offset of 0.09 g.
    in_g = np.tile([0.0, 0.0, 0.9], (1000, 1))
    assert measures_gravity(ReferenceTable("reference", t[:1000], in_g, "acceleration", "ax"))
    assert not measures_gravity(ReferenceTable("reference", t[:1000], in_g, "acceleration", "ax", unit_stated=True))


def test_a_stated_unit_is_believed_and_the_size_told() -> None:
    t = np.arange(1000) / RATE_HZ
    felt = np.tile([0.0, 0.0, 2550.0], (1000, 1))
    stated = ReferenceTable("reference", t, felt, "acceleration", "ax", unit_stated=True)
    check_gravity(stated)
    (line,) = gravity_warnings(stated)
    assert line.startswith("the reference reads 260 g where it feels gravity, 1 g")
    assert gravity_warnings(ReferenceTable("reference", t, felt / 260.0, "acceleration", "ax", unit_stated=True)) == []
    assert gravity_warnings(ReferenceTable("reference", t, felt[:, 2:], "acceleration", "a")) != []
    assert gravity_warnings(ReferenceTable("reference", t, felt[:, 2:] / 600.0, "acceleration", "a")) == []


QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
PLACES = {
    "alpha the other way": (np.diag([-1.0, 1.0, 1.0]), "det S is negative"),
    "all signs": (-np.eye(3), "det S is negative"),
    "a rotation of 90 deg": (
        np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]),
        "the largest element of rows x and y is off",
    ),
    "outputs exchanged in turn": (np.eye(3)[[1, 2, 0]], "the largest element of rows x, y and z is off"),
    "a half turn": (np.diag([-1.0, -1.0, 1.0]), "Sxx = -26."),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PLACES)
def test_axes_that_are_not_where_they_were_stated_are_valid_with_a_warning(name: str) -> None:
    place, said = PLACES[name]
    found = beside(*triad(place @ S_TRUE))
    assert found.reasons == ()
    assert found.warnings[0].startswith(said)
    np.testing.assert_allclose(found.sensitivity, place @ S_TRUE, rtol=0, atol=0.1)
    assert json.loads(found.to_json())["warnings"] == list(found.warnings)


@pytest.mark.slow
def test_a_sensor_turned_by_thirty_degrees_needs_its_rotation() -> None:
    c, s = np.cos(np.deg2rad(30.0)), np.sin(np.deg2rad(30.0))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    sensor, reference = triad(turn=turn)
    reason = only_reason(beside(sensor, reference))
    assert "% of the largest sensitivity of row" in reason
    assert "correct the poses or the rotation" in reason
    right(beside(sensor, reference, rotation=turn))


def test_one_short_window_is_refused_and_a_longer_one_is_not() -> None:
    sensor, reference = triad(seconds=20.0)
    short = [part[:800] for part in sensor], [part[:800] for part in reference]
    reason = only_reason(beside(*(tuple(each) for each in short)))
    assert "only one window of" in reason
    assert "two windows, or 10 s" in reason
    right(of_twenty_seconds())


ALPHAS_DEG = (0.0, 30.0, 120.0, 210.0)
STAY_S = 8.0


def clamped(
    seed: int = 5,
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray], list[dict[str, float]]]:
    """The paper's clamp at theta 35 deg, each alpha twice, five tones at once; 2 s of rest after each stay."""
    random = np.random.default_rng(seed)
    t = np.arange(round(STAY_S * RATE_HZ)) / RATE_HZ
    still = np.zeros(round(2.0 * RATE_HZ))
    u, V, poses = [], [], []
    for k, alpha_deg in enumerate([*ALPHAS_DEG, *ALPHAS_DEG]):
        phases = random.uniform(0.0, 2.0 * np.pi, 5)
        tones = 1.2 * np.sin(2.0 * np.pi * np.outer(t, (0.8, 1.3, 2.1, 3.7, 5.2)) + phases).sum(axis=1)
        u.append(np.append(tones, still))
        direction, gravity = frame(np.deg2rad(35.0), np.deg2rad(alpha_deg))
        V.append((np.outer(u[-1], direction) + G_MPS2 * gravity) @ S_TRUE.T + Q_TRUE)
        start_s = k * (STAY_S + 2.0)
        poses.append({"start_s": start_s, "stop_s": start_s + STAY_S, "theta_deg": 35.0, "alpha_deg": alpha_deg})
    motion, outputs = np.concatenate(u), np.concatenate(V)
    time_s = np.arange(len(motion)) / RATE_HZ
    noisy = outputs + 0.1 * random.normal(size=outputs.shape)
    return (time_s, noisy), (time_s, motion + 0.002 * random.normal(size=len(motion))), poses


def test_what_the_next_tests_are_told_to_do_is_accepted() -> None:
    """A reference in m/s2, angles in deg, outputs in their order, a nominal sensitivity per m/s2."""
    right(calibrate(*clamped()))
    right(calibrate(*clamped(), nominal=26.0, u_nominal_pct=10.0))


@pytest.mark.nightly
def test_a_uniaxial_reference_in_another_unit_is_found_by_gravity() -> None:
    sensor, (time_s, a), poses = clamped()
    reason = only_reason(calibrate(sensor, (time_s, a / G_MPS2), poses))
    assert reason.startswith("the data fit if the reference is multiplied by 9.807: chi-squared")
    assert "it is in g" in reason


def in_rad(poses: list[dict[str, float]], *names: str) -> list[dict[str, float]]:
    return [row | {name: np.deg2rad(row[name]) for name in names} for row in poses]


@pytest.mark.slow
@pytest.mark.parametrize("names", [("alpha_deg",), pytest.param(("theta_deg", "alpha_deg"), marks=pytest.mark.nightly)])
def test_angles_in_rad_are_named(names: tuple[str, ...]) -> None:
    sensor, reference, poses = clamped()
    found = calibrate(sensor, reference, in_rad(poses, *names))
    assert found.status == "refused"
    said = [reason for reason in found.reasons if "multiply it by 180/pi, to have deg" in reason]
    assert [reason.split(": ")[1].split(" is ")[0] for reason in said] == list(names)


def in_ms(table: Table) -> Table:
    return 1000.0 * table[0], table[1]


@pytest.mark.thorough
def test_times_in_ms_are_named_for_the_table_that_has_them() -> None:
    sensor, reference = triad(seconds=20.0)
    for given, name in (((in_ms(sensor), reference), "sensor"), ((sensor, in_ms(reference)), "reference")):
        found = beside(*given)
        assert found.status == "refused"
        assert f"the times of {name} are in ms; divide them by 1000" in found.reasons[0]
    found = beside(in_ms(sensor), in_ms(reference))
    assert found.reasons[0].startswith(
        "by its times the sensor's sampling rate is 0.1 Hz: if they are in ms, divide all"
    )
    right(of_twenty_seconds())


@pytest.mark.two_cases
@pytest.mark.parametrize(("channel", "times"), [(0, 0.0), (1, 1.0 / 30.0), (2, 0.0)])
def test_a_dead_channel_of_the_reference_is_named_and_no_output_called_dead(channel: int, times: float) -> None:
    sensor, (t, a) = triad()
    dead = a.copy()
    dead[:, channel] *= times
    found = beside(sensor, (t, dead))
    assert found.status == "refused"
    axis = "xyz"[channel]
    assert (
        f"channel {axis} of reference is dead" in found.reasons[0]
        or f"channel along {axis} is dead" in found.reasons[0]
    )
    assert not any(reason.startswith("output ") for reason in found.reasons)


@pytest.mark.thorough
def test_a_dead_channel_is_found_behind_a_rotation() -> None:
    sensor, (t, a) = triad(turn=QUARTER_TURN)
    dead = a.copy()
    dead[:, 0] = 0.0
    assert "channel x of reference is dead" in beside(sensor, (t, dead), rotation=QUARTER_TURN).reasons[0]
    right(beside(sensor, (t, a), rotation=QUARTER_TURN))


@pytest.mark.slow
@pytest.mark.parametrize("until_s", [15.0, 40.0])
def test_an_output_that_is_stuck_is_named(until_s: float) -> None:
    (t, V), reference = triad()
    stuck = V.copy()
    stuck[t < until_s, 1] = 777.0
    found = beside((t, stuck), reference)
    assert found.status == "refused"
    assert found.reasons[0].startswith("output y of sensor is stuck: it does not change at all in ")
    after = t >= 15.0
    right(beside((t[after], V[after]), (reference[0][after], reference[1][after])))


MIXED = {
    "output x inverted": (np.diag([-1.0, 1.0, 1.0]), "Sxx = -26.", "the sensor indicates the opposite"),
    "outputs x and y exchanged": (np.eye(3)[[1, 0, 2]], "rows x and y is off the diagonal", "axes are exchanged"),
}


@pytest.mark.one_case
@pytest.mark.parametrize("name", MIXED)
def test_exchanged_and_inverted_outputs_are_named_where_a_nominal_is_stated(name: str) -> None:
    place, *told = MIXED[name]
    (t, V), reference, poses = clamped()
    reason = only_reason(calibrate((t, V @ place.T), reference, poses, nominal=26.0, u_nominal_pct=10.0))
    for part in ("the data contradict the prior", *told):
        assert part in reason


@pytest.mark.slow
def test_a_nominal_sensitivity_per_g_is_named() -> None:
    given = clamped()
    reason = only_reason(calibrate(*given, nominal=26.0 * G_MPS2, u_nominal_pct=10.0))
    assert "all main sensitivities are about 0.102 times what was expected: the prior is per g; convert it" in reason


@pytest.mark.nightly
def test_a_self_test_that_was_left_on_for_some_windows_is_named() -> None:
    (t, V), reference, poses = clamped()
    on = V.copy()
    on[t < 39.0, 2] += 26.0 * 5.0
    reason = only_reason(calibrate((t, on), reference, poses))
    assert "the mean of output z alone differs" in reason
    assert "self-test that was left on" in reason
    right(calibrate((t, on), reference, poses[4:]))


@pytest.mark.thorough
def test_a_self_test_that_was_on_all_the_time_contradicts_what_was_known() -> None:
    (t, V), reference, poses = clamped()
    known = calibrate((t, V), reference, poses)
    found = calibrate((t, V + np.array([0.0, 0.0, 26.0 * 5.0])), reference, poses, prior=known)
    assert found.status == "refused"
    assert "Qz is" in found.reasons[0]
    assert "a self-test was left on" in found.reasons[0]
    earlier = {"sensitivity": known.sensitivity, "offset": known.offset, "covariance": 25.0 * known.covariance}
    right(calibrate((t, V), reference, poses, prior=earlier))


def test_no_unit_is_printed_that_says_nothing() -> None:
    assert with_unit(-0.919, "1") == "-91.9 %"
    assert with_unit(np.deg2rad(2.0), "rad") == "2 deg"
    assert with_unit(0.05, "m/s2") == "0.05 m/s2"
    assert NuisanceValue("response_2", -0.02, 0.185, "1").cell(2.0) == "-0.02 ± 0.37"
    assert NuisanceValue("gravity", 0.001, 0.01, "m/s2").cell(2.0) == "0.001 ± 0.020 m/s2"


def test_a_refused_result_is_no_prior() -> None:
    sensor, reference = triad(seconds=20.0)
    refused = beside(in_ms(sensor), reference)
    with pytest.raises(OptionError, match="it tells no main sensitivity; give a result that is valid"):
        beside(sensor, reference, prior=refused)
