"""Epochs of the past as StationXML: valid by the schema of the FDSN, and as ObsPy reads it back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.core.past import KnownPast
from agent.export.past import SensorPast
from agent.export.samples import ExportError, RecordedContent
from agent.export.stationxml import StationPlace, write_stationxml
from calib.estimate.correction import Law
from calib.state.past import Past
from tests.unit.recorded_bench import EPOCH_NS

pytest.importorskip("obspy", reason="ObsPy is not installed (extra seismic)")
PLACE = StationPlace(47.5, 8.25, 412.0)
HOUR_NS = 3600 * 10**9


def checked(path: Path) -> None:
    """By the schema of the FDSN, as ObsPy carries it."""
    from obspy.io.stationxml.core import validate_stationxml

    valid, errors = validate_stationxml(str(path))
    assert valid, errors


def law(S: float, Q: float = 5.0, determined: bool = True) -> Law:
    mean = np.append((S * np.eye(3) + 0.01).ravel(), [Q] * 3)
    return Law(mean, np.diag(np.append(np.full(9, 0.25), [1.0] * 3)), determined=np.full(12, determined))


def past_of(device: str, days: dict[float, Law], windows: tuple[int, ...], unit: str = "count") -> SensorPast:
    """A device with epochs on these days; day 10 is EPOCH_NS."""
    past = Past(np.array(list(days)), list(days.values()), windows, (), min(days), 2.0)
    known = KnownPast("mems", device, device, unit, past, "0" * 64, 1.25, 10.0, EPOCH_NS)
    return SensorPast("mems", device, known, tuple(("run", k) if k else None for k in range(len(days))))


def written(path: Path, *found: SensorPast, unit: str = "count", rate_hz: float = 200.0, site: str = "site") -> Any:
    from obspy import read_inventory

    write_stationxml(path, RecordedContent("mems", unit, 3), found, site=site, rate_hz=rate_hz, place=PLACE)
    checked(path)
    return read_inventory(path)


def ns(day: float) -> int:
    return EPOCH_NS + round((day - 10.0) * 24 * HOUR_NS)


def test_each_epoch_has_its_time_and_its_sensitivity_with_u(tmp_path: Path) -> None:
    days, sizes = [1.0, 3.0, float(np.nextafter(7.0, 0)), 7.0, 8.0], (100.0, 102.0, 104.0, 140.0, 141.0)
    laws = dict(zip(days, map(law, sizes), strict=True))
    inventory = written(tmp_path / "a.xml", past_of("A", laws, (1, 1, 0, 0, 1)))
    (station,) = inventory[0].stations
    assert (inventory[0].code, station.code, station.latitude, station.elevation) == ("XX", "MEMS", 47.5, 412.0)
    seen = {(c.location_code, c.code) for c in station}
    assert seen == {("00", f"HN{k}") for k in (1, 2, 3)}
    own = [c for c in station if c.code == "HN1"]
    starts = [1.0 - 1.0 / 24.0, 2.0, 5.0, 7.0, 7.5]
    assert [c.start_date.ns for c in own] == [pytest.approx(ns(day), abs=2000) for day in starts]
    assert [c.end_date for c in own] == [*(c.start_date for c in own[1:]), None]
    for channel, S in zip(own, (100.01, 102.01, 104.01, 140.01, 141.01), strict=True):
        told, (stage,) = channel.response.instrument_sensitivity, channel.response.response_stages
        assert (told.value, told.frequency) == (S, 1.25) == (stage.stage_gain, stage.stage_gain_frequency)
        assert (told.input_units, told.output_units) == ("m/s**2", "count")
        (one,) = stage.numerator
        assert one == 1.0
        for relative in (one.upper_uncertainty, one.lower_uncertainty):  # ObsPy 1.5 reads them as text
            assert float(relative) == pytest.approx(1.0 / S)
        response = channel.response.get_evalresp_response_for_frequencies([0.1, 1.0, 10.0], output="ACC")
        np.testing.assert_allclose(response, S, rtol=1e-9)
        text = channel.comments[0].value
        assert f"Sxx = {S:.1f} ± 1.0 count/(m/s2), Sxy = 0.0 ± 1.0 count/(m/s2)" in text
        assert "Qx = 5.0 ± 2.0 count; U with k = 2" in text
    in_force = [c.comments[1].value.rpartition(": ")[2] for c in own]
    assert in_force == ["none was", *(f"number {k} of run run" for k in (1, 2, 3, 4))]


@pytest.mark.parametrize(
    "name", ["A&<b>\"'", "a\x00b\x1b[31m\ufffe\uffff", "\u202egnp", "日本 ü", "x" * 3000, "]]>", "\ud800", ""]
)
def test_names_with_odd_characters_stay_valid(name: str, tmp_path: Path) -> None:
    inventory = written(tmp_path / "a.xml", past_of(name, {1.0: law(1.0)}, (1,)), site=name)
    assert inventory[0][0][0].sensor.description or not name


UNITS = [("count", "count"), ("V", "V"), ("mV", "mV"), ("m/s2", "m/s**2"), ("g", "g"), ("", "output unit")]


@pytest.mark.parametrize(("unit", "told"), UNITS)
def test_units(unit: str, told: str, tmp_path: Path) -> None:
    inventory = written(tmp_path / "a.xml", past_of("A", {1.0: law(-2.0)}, (1,), unit), unit=unit)
    sensitivity = inventory[0][0][0].response.instrument_sensitivity
    assert (sensitivity.value, sensitivity.output_units) == (-1.99, told)  # the axis points the other way


def test_epochs_of_devices_one_after_the_other_do_not_overlap(tmp_path: Path) -> None:
    """A is used, then B, then A again; the past of A has an epoch within its gap."""
    first = past_of("A", {1.0: law(1.0), 4.0: law(1.5), 7.0: law(2.0)}, (1, 0, 1))
    second = past_of("B", {3.0: law(10.0), 5.0: law(11.0)}, (1, 1))
    own = [c for c in written(tmp_path / "a.xml", second, first)[0][0] if c.code == "HN1"]
    assert [c.sensor.description for c in own] == ["A", "B", "B", "A"]
    assert [c.end_date for c in own] == [*(c.start_date for c in own[1:]), None]
    assert [c.start_date.ns for c in own[1:]] == [pytest.approx(ns(day), abs=2000) for day in (2.0, 4.0, 6.0)]


def test_what_is_not_known_has_no_sensitivity(tmp_path: Path) -> None:
    (channel, *_) = written(tmp_path / "a.xml", past_of("A", {1.0: law(1.0, determined=False)}, (1,)))[0][0]
    assert channel.response is None or channel.response.instrument_sensitivity is None
    assert "Sxx is not known" in channel.comments[0].value
    with pytest.raises(ExportError, match=r"mems has no past: no window was taken"):
        write_stationxml(
            tmp_path / "b.xml", RecordedContent("mems", "count", 3),
            [SensorPast("mems", "A", None, why="no window was taken")],
            site="", rate_hz=1.0, place=PLACE,
        )  # fmt: skip
    assert not (tmp_path / "b.xml").exists()
