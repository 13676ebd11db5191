"""`fieldcal calibrate` with MiniSEED and StationXML, as ObsPy writes them: two instruments at one place."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, csd, sosfilt

from agent.calibrate.tables import read_reference, read_sensor
from agent.cli.main import run_cli
from agent.reading.formats import Description
from agent.reading.source import TableError
from agent.reading.stationxml import read_stationxml
from tests.unit.seismic_station import (
    ACCELEROMETER,
    SHORT,
    STS2,
    Channel,
    Station,
    ground,
    indications,
    write_mseed,
    write_stationxml,
)

obspy = pytest.importorskip("obspy", reason="ObsPy is not installed (extra seismic)")
pytestmark = pytest.mark.filterwarnings("default")  # ObsPy's own
RATE_HZ, SECONDS, G, OFFSET = 25.0, 60.0, 9.80665, 5e5
REFERENCE = [Channel("HHE", 6e8, 90.0, 0.0), Channel("HHN", 6.1e8, 0.0, 0.0), Channel("HHZ", 5.9e8, 0.0, -90.0)]
STATED = [Channel("BH1", 4e8, 30.0, 0.0), Channel("BH2", 4e8, 120.0, 0.0), Channel("BHZ", 4e8, 0.0, -90.0)]
TRUE = [Channel("BH1", 4.12e8, 33.0, 0.5), Channel("BH2", 3.98e8, 122.0, 0.0), Channel("BHZ", 4e8, 0.0, -90.0)]


VERTICAL = [Channel("EHZ", 1500.0, 0.0, -90.0)]
LEVEL = [Channel(f"HH{c}", 4e8, 0.0, 0.0) for c in "ENZ"]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reference (velocity, 120 s), FIELD (velocity with a corner at 1 Hz), and ACC (acceleration) on one ground.

    One StationXML describes them, the two instruments of ObsPy, and stations with faults.
    """
    directory = tmp_path_factory.mktemp("site")
    a = ground(SECONDS, RATE_HZ, 3, high_hz=5.0)
    felt = a + np.array([0.0, 0.0, G])
    instruments = {
        "REF": (REFERENCE, indications(a, RATE_HZ, REFERENCE, STS2, "M/S")),
        "FIELD": (TRUE, indications(a, RATE_HZ, TRUE, SHORT, "M/S")),
        "ACC": (TRUE, 1e-2 * indications(felt, RATE_HZ, TRUE, ACCELEROMETER, "M/S**2") + OFFSET),
    }
    for seed, (station, (channels, counts)) in enumerate(instruments.items()):
        noise = 1e-3 * counts.std(axis=0) * np.random.default_rng(seed).normal(size=counts.shape)
        write_mseed(directory / f"{station}.mseed", station, channels, counts + noise, RATE_HZ)
    stated = [Channel(c.code, 4e6, c.azimuth_deg, c.dip_deg) for c in STATED]
    write_stationxml(directory / "station.xml", [
        Station("REF", REFERENCE, RATE_HZ, STS2), Station("FIELD", STATED, RATE_HZ, SHORT),
        Station("ACC", stated, RATE_HZ, ACCELEROMETER, "M/S**2"),
        Station("STS2", VERTICAL, 200.0, STS2, network="CA"), Station("0438", VERTICAL, 200.0, STS2, network="CA"),
        Station("RATE", LEVEL, 20.0, STS2), Station("LATER", LEVEL, RATE_HZ, STS2, since=2030),
        Station("UNIT", LEVEL, RATE_HZ, STS2, "PA"), Station("LEVEL", LEVEL, RATE_HZ, STS2),
    ])  # fmt: skip
    return directory


def calibrated(site: Path, station: str, capsys: pytest.CaptureFixture[str], *more: str) -> tuple[dict[str, Any], str]:
    files = {"sensor": f"{station}.mseed", "reference": "REF.mseed"}
    files |= {"sensor-metadata": "station.xml", "reference-metadata": "station.xml"}
    words = [word for option, name in files.items() for word in (f"--{option}", str(site / name))]
    status = run_cli(["calibrate", *words, "--json", "-", *more])
    told = capsys.readouterr()
    assert status == 0, told.err
    return json.loads(told.out), told.err


@pytest.mark.thorough
def test_sensitivity_and_orientation_of_a_seismometer(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found, said = calibrated(site, "FIELD", capsys, "--stationxml-out", str(tmp_path / "new.xml"))
    told = {each["channel"].rpartition(".")[2]: each for each in found["station"]}
    for stated, true in zip(STATED, TRUE, strict=True):
        of = told[true.code]
        assert of["unit"] == "counts/(m/s)"
        assert of["sensitivity"]["stated"] == pytest.approx(stated.sensitivity, rel=1e-6)
        assert of["sensitivity"]["found"] == pytest.approx(true.sensitivity, rel=1e-3)
        assert of["dip_deg"]["found"] == pytest.approx(true.dip_deg, abs=0.05)
        for name, value in {"sensitivity": true.sensitivity, "dip_deg": true.dip_deg}.items():
            assert abs(of[name]["found"] - value) < of[name]["expanded_uncertainty"], name
        if true.code != "BHZ":
            assert of["azimuth_deg"]["found"] == pytest.approx(true.azimuth_deg, abs=0.05)
    assert told["BHZ"]["azimuth_deg"]["found"] is None  # a vertical output has none
    differing = {n: [c for c in told if told[c][n]["differs"]] for n in ("sensitivity", "azimuth_deg", "dip_deg")}
    assert {name: sorted(codes) for name, codes in differing.items()} == {
        "sensitivity": ["BH1", "BH2"], "azimuth_deg": ["BH1", "BH2"], "dip_deg": ["BH1"],
    }  # fmt: skip
    assert said.count("the metadata say") == 5
    assert {Path(file["path"]).name for file in found["files"]} == {"FIELD.mseed", "REF.mseed", "station.xml"}

    inventory = obspy.read_inventory(str(tmp_path / "new.xml"))
    proposed = inventory.select(station="FIELD")[0][0]
    for channel, true in zip(proposed, TRUE, strict=True):
        assert channel.response.instrument_sensitivity.value == pytest.approx(true.sensitivity, rel=1e-3)
        assert channel.response.response_stages[0].stage_gain == pytest.approx(true.sensitivity, rel=1e-3)
        assert channel.dip == pytest.approx(true.dip_deg, abs=0.05)
        assert f"before {told[true.code]['sensitivity']['stated']:.9g}" in channel.comments[0].value
    assert proposed[0].azimuth == pytest.approx(33.0, abs=0.05)
    assert proposed[2].azimuth == 0.0  # as it was
    other = inventory.select(station="REF")[0][0][1]
    assert other.response.instrument_sensitivity.value == pytest.approx(6.1e8, rel=1e-6)
    assert not other.comments


@pytest.mark.thorough
def test_an_accelerometer_beside_a_seismometer_feels_gravity(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found, _ = calibrated(site, "ACC", capsys)
    told = {each["channel"].rpartition(".")[2]: each for each in found["station"]}
    assert told["BH1"]["sensitivity"]["found"] == pytest.approx(4.12e6, rel=1e-3)
    assert told["BH1"]["unit"] == "counts/(m/s**2)"
    U = np.array(found["expanded_uncertainty"]["offset"])
    assert np.all(np.abs(np.array(found["offset"]) - OFFSET) < U)
    assert np.all(U < 4e6 * 0.25)  # the dip of 0.5 deg is 0.086 m/s2; u of gravity, of the rotation and of Q


@pytest.mark.slow
def test_the_pair_of_obspy(site: Path) -> None:
    """A vertical pair of seismometers in ObsPy's own test data, as its files are; ObsPy's correction is the same."""
    data = Path(obspy.__file__).parent / "signal" / "tests" / "data"
    if not (data / "ref_STS2").is_file():
        pytest.skip("this ObsPy comes without its test data")
    metadata = Description(site / "station.xml")
    columns = "time=time_s,x=z,y=z,z=z"  # an instrument with one output
    sensor = read_sensor(data / "ref_unknown", None, columns, metadata)
    reference = read_reference(data / "ref_STS2", described=metadata)
    assert reference.quantity == "acceleration"
    assert reference.components[0].direction.tolist() == sensor.components[2].direction.tolist() == [0.0, 0.0, 1.0]

    trace = obspy.read(str(data / "ref_STS2"))[0]
    trace.remove_response(obspy.read_inventory(str(metadata.metadata)), output="ACC", water_level=None)
    middle = slice(2**17, 2**18)
    np.testing.assert_allclose(
        lowpassed(reference.x[:][:, 0])[middle], lowpassed(trace.data)[middle], atol=2e-3 * trace.data[middle].std()
    )
    # ratio of the two by Welch's spectra, with the responses as they are in the files: 0.768 at 2 Hz
    f, cross = csd(reference.x[:][:, 0], sensor.v[:][:, 2], 200.0, nperseg=8192)
    _, power = csd(reference.x[:][:, 0], reference.x[:][:, 0], 200.0, nperseg=8192)
    at = (f > 1.5) & (f < 2.5)
    assert np.median(np.abs(cross[at] / power[at])) == pytest.approx(1500.0 * 0.768, rel=0.01)


def lowpassed(x: np.ndarray) -> np.ndarray:
    """From 0.2 to 20 Hz, where no taper at the ends and no drift is left."""
    return np.asarray(sosfilt(butter(4, [0.2, 20.0], "bandpass", fs=200.0, output="sos"), x))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("station", "message"),
    [
        (
            "NONE",
            r"there is no channel XX.NONE..HHE; it has CA.0438..EHZ, .* and \d+ more; give the",
        ),
        ("RATE", "channel XX.RATE..HHE: the sample rate is 20 Hz, that of the data is 25 Hz"),
        ("LATER", "there is no channel XX.LATER..HHE at the time of the data"),
        ("UNIT", "channel XX.UNIT..HHE: the unit of its input is 'PA'; known are"),
        ("LEVEL", "the channels do not measure three directions"),
    ],
)
def test_metadata_that_do_not_belong_to_the_data(station: str, message: str, site: Path, tmp_path: Path) -> None:
    write_mseed(tmp_path / "a.mseed", station, LEVEL, np.arange(300.0).reshape(100, 3), RATE_HZ)
    with pytest.raises(TableError, match=message) as told:
        read_reference(tmp_path / "a.mseed", described=Description(site / "station.xml"))
    assert str(told.value).startswith(str(site / "station.xml"))
    assert "\n" not in str(told.value)


def test_metadata_are_for_miniseed(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time_s,a\n0,1\n1,2\n")
    with pytest.raises(TableError, match=r"it describes MiniSEED, but .*a.csv is CSV; leave it out"):
        read_reference(tmp_path / "a.csv", described=Description(tmp_path / "b.xml"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b'<?xml version="1.0"?>\n<!DOCTYPE x [<!ENTITY a "aaaa">]><x>&a;</x>', "line 2: the XML has a document type"),
        ('<!DOCTYPE x SYSTEM "file:///etc/passwd"><x/>'.encode("utf-16"), "not in UTF-8"),
        (b'<?xml version="1.0" encoding="UTF-7"?><x/>', "not in UTF-8"),
        (b"<a><b></a>", "the file is no StationXML that can be read: .*; write it anew"),
    ],
)
def test_hostile_xml_is_refused_before_it_is_parsed(data: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_bytes(data)
    with pytest.raises(TableError, match=message) as told:
        read_stationxml(path)
    assert str(told.value).startswith(str(path))
