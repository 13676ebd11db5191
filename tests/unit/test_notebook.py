"""`calib.calibrate` on arrays: the same numbers as the command, every kind of table, each fault with its place."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.cli.main import run_cli
from calib import Calibration, InputError, calibrate
from calib.distributions import coverage_factor
from calib.recorded.errors import OptionError
from calib.recorded.options import DEFAULTS, Options
from calib.recorded.outcome import Outcome
from docs.images.notebook_run import NOTEBOOK, outputs

ROOT = Path(__file__).parents[2]
S = np.array([[1.02, 0.01, -0.005], [-0.008, 0.99, 0.012], [0.004, -0.006, 1.01]])
Q = np.array([0.3, -0.1, 0.2])
ALPHAS_DEG = (0.0, 60.0, 120.0, 180.0, 240.0, 300.0)
Columns = dict[str, Any]


def recorded() -> tuple[Columns, Columns, list[Columns]]:
    """A sensor on the clamp, 10 s in each position, beside a uniaxial reference with another rate."""
    from calib import clamp

    random = np.random.default_rng(3)
    poses = [{"start_s": 10.0 * k, "stop_s": 10.0 * k + 10, "theta_deg": 35.0, "alpha_deg": a}
             for k, a in enumerate(ALPHAS_DEG)]  # fmt: skip
    t, r = np.arange(0.0, 60.0, 1 / 199.7), np.arange(0.0, 60.0, 1 / 250)
    hz, phase = random.uniform(1.0, 10.0, 20), random.uniform(0.0, 6.3, 20)

    def motion(time_s: np.ndarray) -> np.ndarray:
        return np.cos(2 * np.pi * np.outer(time_s, hz) + phase).sum(axis=1)

    directions, gravities = (
        np.array([each(clamp(np.deg2rad(35), np.deg2rad(a))) for a in ALPHAS_DEG])
        for each in (lambda pose: pose.direction[:, 0], lambda pose: pose.gravity_mps2)
    )
    at = (t // 10).astype(int)
    V = (motion(t - 0.001)[:, None] * directions[at] + gravities[at]) @ S.T + Q + random.normal(0, 0.01, (len(t), 3))
    a = motion(r) + random.normal(0, 0.003, len(r))
    return dict(zip(("time_s", "vx", "vy", "vz"), (t, *V.T), strict=True)), {"time_s": r, "a": a}, poses


SENSOR, REFERENCE, POSES = recorded()
OPTIONS = {"u_angle_deg": 0.1, "gravity": 9.80665}


@pytest.fixture(scope="module")
def result() -> Outcome:
    return calibrate(SENSOR, REFERENCE, POSES, **OPTIONS)


def as_csv(path: Path, columns: Columns) -> str:
    rows = zip(*(np.asarray(values).tolist() for values in columns.values()), strict=True)
    path.write_text("\n".join([",".join(columns), *(",".join(map(repr, row)) for row in rows)]) + "\n")
    return str(path)


@pytest.mark.slow
def test_the_command_gives_the_same_object_to_the_last_bit(result: Outcome, tmp_path: Path) -> None:
    poses = {name: [row[name] for row in POSES] for name in POSES[0]}
    files = [f"--{name}={as_csv(tmp_path / f'{name}.csv', columns)}"
             for name, columns in (("sensor", SENSOR), ("reference", REFERENCE), ("poses", poses))]  # fmt: skip
    to = tmp_path / "result.json"
    assert run_cli(["calibrate", *files, "--u-angle-deg=0.1", "--gravity=9.80665", f"--json={to}"]) == 0
    of_files = json.loads(to.read_text())
    assert {"options", "files"} <= set(of_files)
    assert json.loads(result.to_json()) == {k: v for k, v in of_files.items() if k not in ("options", "files")}


def test_the_result_tells_the_truth_and_cannot_be_changed(result: Outcome) -> None:
    assert (result.status, result.reasons) == ("valid", ())
    away = np.abs(result.values - [*S.ravel(), *Q]) / result.expanded_uncertainty
    assert away.max() < 1.0
    assert result.lag_s == pytest.approx(0.001, abs=1e-4)
    assert result.reference_frequency_hz is not None
    assert 1.0 < result.reference_frequency_hz < 10.0
    np.testing.assert_allclose(result.standard_uncertainty**2, np.diag(result.covariance))
    np.testing.assert_array_equal(result.expanded_uncertainty, result.coverage_factor * result.standard_uncertainty)
    assert result.determined.all()
    assert len(result.windows) == 6
    for band in result.response:
        np.testing.assert_allclose(np.abs(np.diag(band.sensitivity)), np.diag(S), rtol=0.03)
    for array in (result.sensitivity, result.offset, result.covariance, result.determined, result.values):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    with pytest.raises(AttributeError):
        result.reasons = ("none",)  # type: ignore[misc]


def structured(columns: Columns) -> np.ndarray:
    found = np.empty(len(columns["time_s"]), dtype=[(name, float) for name in columns])
    for name, values in columns.items():
        found[name] = values
    return found


def frame(columns: Any) -> Any:
    return pytest.importorskip("pandas", reason="the test of DataFrames needs pandas").DataFrame(columns)


def pair(columns: Columns) -> tuple[Any, Any]:
    time_s, *values = columns.values()
    return time_s, np.column_stack(values) if len(values) > 1 else values[0]


@pytest.mark.one_case
@pytest.mark.parametrize("form", [frame, structured, pair, lambda columns: np.column_stack(list(columns.values()))])
def test_every_kind_of_table_gives_the_same(result: Outcome, form: Callable[[Columns], Any]) -> None:
    poses = frame(POSES) if form is frame else POSES
    assert calibrate(form(SENSOR), form(REFERENCE), poses, **OPTIONS).to_json() == result.to_json()


def spoilt(columns: Columns, name: str, row: int, value: float) -> Columns:
    values = np.array(columns[name])
    values[row] = value
    return columns | {name: values}


def posed(row: int, **changes: Any) -> list[Columns]:
    return [pose | changes if k == row else pose for k, pose in enumerate(POSES)]


FAULTS: list[tuple[Callable[[], Outcome], tuple[str, int | None, str], str]] = [
    (lambda: calibrate(spoilt(SENSOR, "vy", 7, np.inf), REFERENCE, POSES), ("sensor", 7, "vy"), "inf is not a finite"),
    (lambda: calibrate(SENSOR, spoilt(REFERENCE, "time_s", 9, 1.0), POSES), ("reference", 10, "time_s"), "decrease"),
    (lambda: calibrate({"time_s": [0, 1], "vx": [1, 2]}), ("sensor", None, "vy"), "missing; the columns are time_s"),
    (lambda: calibrate(SENSOR | {"vz": [1.0]}), ("sensor", None, "vz"), "1 values, but 11982 times"),
    (lambda: calibrate(SENSOR | {"vz": ["x"] * 11982}), ("sensor", 0, "vz"), "'x'.* is no number"),
    (lambda: calibrate(SENSOR | {"vz": 1j * SENSOR["vz"]}), ("sensor", 0, "vz"), "is no number"),
    (lambda: calibrate(np.ones((5, 3))), ("sensor", None, ""), "there are 3 columns; give 4: time_s, vx, vy, vz"),
    (lambda: calibrate({"secs": [1, 1], "nsecs": [0, 5]} | {k: [0.0, 1.0] for k in "xyz"}), ("sensor", None, ""),
     "'secs' has whole seconds, and 'nsecs' their parts.*write the sum of both in one column"),
    (lambda: calibrate("sensor.csv"), ("sensor", None, ""), "str is no table; give a DataFrame"),
    (lambda: calibrate(SENSOR, REFERENCE | {"v": REFERENCE["a"]}, POSES), ("reference", None, ""), "give one of"),
    (lambda: calibrate(SENSOR, REFERENCE, posed(2, stop_s=1.0)), ("poses", 2, "stop_s"), "1 is not after start_s 20"),
    (lambda: calibrate(SENSOR, REFERENCE, posed(2, start_s=15.0)), ("poses", 2, "start_s"), "from 10 s to 20 s"),
    (lambda: calibrate(SENSOR, REFERENCE, posed(1, alpha_deg=np.nan)), ("poses", 1, "alpha_deg"), "nan is not"),
    (lambda: calibrate(SENSOR, REFERENCE, [POSES[0], {"start_s": 1}]), ("poses", 1, "stop_s"), "is missing"),
    (lambda: calibrate(SENSOR, REFERENCE, []), ("poses", None, ""), "there are no poses"),
    (lambda: calibrate(SENSOR, REFERENCE), ("", None, ""), "`poses` is missing"),
    (lambda: calibrate(SENSOR, nominal=1.0), ("", None, ""), "`nominal` and `u_nominal_pct` must be given together"),
    (lambda: calibrate(SENSOR, u_tilt_deg=-1), ("", None, "u_tilt_deg"), "-1 cannot be used; give a number from 0 on"),
    (lambda: calibrate(SENSOR, method=4), ("", None, "method"), "4 cannot be used; choose one of 1, 2, 3"),
    (lambda: calibrate(SENSOR, rotation=[1, 2]), ("", None, "rotation"), "give 3 x 3 numbers"),
    (lambda: calibrate(SENSOR, prior={}), ("", None, "prior"), "give a result of `calibrate`"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "place", "message"), FAULTS)
def test_a_fault_is_named_with_its_place(
    call: Callable[[], Outcome], place: tuple[str, int | None, str], message: str
) -> None:
    with pytest.raises(InputError, match=message) as error:
        call()
    assert (error.value.place, error.value.row, error.value.column) == place


@pytest.mark.slow
def test_a_value_that_is_missing_is_a_gap(result: Outcome) -> None:
    masked = np.ma.MaskedArray(SENSOR["vx"], mask=np.arange(len(SENSOR["vx"])) % 1000 == 500)
    as_nan = SENSOR | {"vx": masked.filled(np.nan)}
    with_gaps = calibrate(SENSOR | {"vx": masked}, REFERENCE, POSES, **OPTIONS)
    assert with_gaps.to_json() == calibrate(as_nan, REFERENCE, POSES, **OPTIONS).to_json() != result.to_json()
    assert with_gaps.status == "valid"


def test_the_coverage_factor_rests_on_the_fewest_effective_degrees_of_freedom(result: Outcome) -> None:
    told = json.loads(result.to_json())["effective_degrees_of_freedom"]
    freedom = np.append(np.array(told["sensitivity"], dtype=float), np.array(told["offset"], dtype=float))
    assert result.coverage_factor == pytest.approx(coverage_factor(freedom[result.determined].min()), rel=1e-12)


def test_dates_are_times(result: Outcome) -> None:
    def dated(columns: Columns) -> Columns:
        return columns | {
            "time_s": np.datetime64("2026-01-01", "ns") + np.round(columns["time_s"] * 1e9).astype("m8[ns]")
        }

    start_s = float(np.datetime64("2026-01-01", "s").astype(int))
    poses = [pose | {name: pose[name] + start_s for name in ("start_s", "stop_s")} for pose in POSES]
    found = calibrate(dated(SENSOR), dated(REFERENCE), poses, **OPTIONS)
    np.testing.assert_allclose(found.values, result.values, rtol=1e-4, atol=1e-5)


@pytest.mark.thorough
def test_an_earlier_result_is_a_prior_in_any_of_its_forms(result: Outcome) -> None:
    forms = [result, result.calibration, json.loads(result.to_json())]
    assert isinstance(forms[1], Calibration)
    one, *others = (calibrate(SENSOR, REFERENCE, POSES, prior=form, **OPTIONS).to_json() for form in forms)
    assert others == [one, one]
    assert one != result.to_json()


@pytest.mark.thorough
def test_data_that_are_refused_are_no_exception() -> None:
    found = calibrate(SENSOR, REFERENCE, POSES, nominal=1.5, u_nominal_pct=1.0)
    assert found.status == "refused"
    assert "contradict" in found.reasons[0]
    assert np.isnan(found.values).all()
    assert not found.determined.any()
    assert "refused" in found._repr_html_()


def test_s_holds_at_a_frequency_within_the_band() -> None:
    given = {"reference": True, "poses": True, "prior": False}
    for at_hz in (1.0, 5.0, 10.0):
        Options(band_hz=(1.0, 10.0), reference_frequency_hz=at_hz).check(**given)
    for at_hz in (0.9, 10.1):
        with pytest.raises(OptionError, match="outside `band_hz`"):
            Options(band_hz=(1.0, 10.0), reference_frequency_hz=at_hz).check(**given)


def test_an_option_that_is_not_there_is_named_with_the_one_that_is_near() -> None:
    with pytest.raises(TypeError, match="no option 'u_angel_deg'; is 'u_angle_deg' meant"):
        calibrate(SENSOR, u_angel_deg=1)


def test_each_option_is_one_of_the_command_with_its_default() -> None:
    from agent.calibrate.stated import options_of
    from agent.cli.calibrate import calibrate as command

    names = {option[2:].replace("-", "_") for p in command.params for option in p.opts}
    assert set(Options.__dataclass_fields__) <= names
    of_the_command = options_of(command.make_context("calibrate", ["--sensor", "s.csv"]).params)
    assert all(getattr(of_the_command, name) == getattr(DEFAULTS, name) for name in Options.__dataclass_fields__)


class Balanced(HTMLParser):
    """Checks that each tag is closed, and collects the tags and the text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open, self.tags, self.said = list[str](), set[str](), ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:  # noqa: ARG002
        self.open.append(tag)
        self.tags.add(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.said += data


def test_what_a_notebook_shows_is_escaped_and_has_no_colours_of_its_own(result: Outcome) -> None:
    from dataclasses import replace

    hostile = "<script>alert(1)</script>"
    window = replace(result.windows[0], used=False, reason=hostile)
    shown = Balanced(replace(result, windows=(window,), method=hostile)._repr_html_())
    assert not shown.open
    assert "script" not in shown.tags
    assert shown.said.count(hostile) == 2
    assert "1.02" in shown.said
    assert "color: #" not in result._repr_html_()
    assert "background" not in result._repr_html_()


@pytest.mark.thorough
def test_what_print_shows_fits_a_screen_and_is_what_the_command_prints(
    result: Outcome, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = {name: [row[name] for row in POSES] for name in POSES[0]}
    files = [f"--{name}={as_csv(tmp_path / f'{name}.csv', columns)}"
             for name, columns in (("sensor", SENSOR), ("reference", REFERENCE), ("poses", poses))]  # fmt: skip
    assert run_cli(["calibrate", *files, "--u-angle-deg=0.1", "--gravity=9.80665"]) == 0
    printed = capsys.readouterr().out.splitlines()
    head, *shown = str(result).splitlines()
    assert head == "valid: method 3 (adjustment), 6 of 6 windows used"
    assert [f"  {line.replace('`u_', '--u-').replace('_', '-').replace('`', '')}" for line in shown] == [
        line.replace("_", "-") for line in printed[-len(shown) :]
    ]
    assert repr(result) == str(result)
    assert len(shown) < 24
    assert max(map(len, shown)) <= 80
    refused = calibrate(SENSOR, REFERENCE, POSES, nominal=1.5, u_nominal_pct=1.0)
    assert str(refused).splitlines()[1].startswith("refused: ")
    assert len(str(refused)) < 2000


def test_warnings_stand_above_the_table(result: Outcome, capsys: pytest.CaptureFixture[str]) -> None:
    from dataclasses import replace

    from agent.calibrate.printing import print_outcome

    warned = replace(result, warnings=("det S is negative", "the reference reads 260 g"))
    print_outcome(warned)
    for lines in (capsys.readouterr().out.splitlines(), str(warned).splitlines()):
        at = next(k for k, line in enumerate(lines) if line.split() == ["Sx", "Sy", "Sz", "Q"])
        assert lines[at - 2 : at] == ["WARNING: det S is negative", "WARNING: the reference reads 260 g"]
    assert "<b>Warning: det S is negative</b>" in warned._repr_html_()
    assert json.loads(warned.to_json())["warnings"] == ["det S is negative", "the reference reads 260 g"]


def test_beside_the_json_object_warnings_are_on_standard_error(
    result: Outcome, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from dataclasses import replace

    monkeypatch.setattr("agent.cli.calibrate.calibrated", lambda _: replace(result, warnings=("det S is negative",)))
    assert run_cli(["calibrate", f"--sensor={as_csv(tmp_path / 'sensor.csv', SENSOR)}", "--json=-"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["warnings"] == ["det S is negative"]
    assert said.err == "WARNING: det S is negative\n"


@pytest.mark.slow
def test_the_figure_shows_s_q_response_and_windows(result: Outcome) -> None:
    figure = result.plot()
    assert [axes.get_title(loc="left").split(":")[0] for axes in figure.axes] == ["S", "Q", "response", "windows"]
    assert figure._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]


@pytest.mark.slow
def test_neither_matplotlib_nor_pandas_is_needed_until_plot() -> None:
    code = (
        "import sys; sys.modules['matplotlib'] = sys.modules['pandas'] = None\n"
        "import numpy as np; from calib import calibrate\n"
        "t = np.arange(200) / 100; found = calibrate((t, np.ones((200, 3))))\n"
        "print(found.status, len(found._repr_html_()) > 100)\n"
        "try: found.plot()\nexcept ImportError as error: print(error)\n"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    told = "plot() needs matplotlib, which is not installed; install it: pip install matplotlib"
    assert run.stdout.splitlines() == ["refused True", told]


@pytest.mark.nightly
def test_the_notebook_runs_and_its_outputs_are_those_of_a_run() -> None:
    """Without Jupyter: the code cells run in order in one name space, as docs/images/notebook_run.py does it."""
    notebook = json.loads(NOTEBOOK.read_text("utf-8"))
    stored = [cell["outputs"] for cell in notebook["cells"] if cell["cell_type"] == "code"]
    found = outputs(notebook)
    assert _without_pictures(found) == _without_pictures(stored)
    assert "refused" in str(stored)
    assert any("image/png" in str(each) for each in stored)
    assert NOTEBOOK.stat().st_size < 100_000


def _without_pictures(found: Any) -> str:
    """The text of outputs; the bytes of a picture depend on the version of matplotlib."""
    for output in (each for cell in found for each in cell):
        if "image/png" in output.get("data", {}):
            output["data"]["image/png"] = "a picture"
    return json.dumps(found)
