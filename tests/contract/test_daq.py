"""The driver contract on `mcc172`, `mcc-usb` and `ni`, each with a twin of its vendor's library."""

from __future__ import annotations

import sys
from abc import abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from hw.block import BlockFlags
from hw.buffered_sensor import BufferedSensor
from hw.conformance.sensor import Rig, SensorContract
from hw.mcc172 import Mcc172
from hw.mcc_usb import MccUsb
from hw.ni_daqmx import Ni
from hw.sensor import ConfigurationError, DeviceLost, IdentityError
from hw.virtual.daqhats_twin import DaqhatsTwin
from hw.virtual.nidaqmx_twin import NidaqmxTwin
from hw.virtual.uldaq_twin import UldaqTwin, ULError

STEP_V = 8e-6  # V per sample number, from the middle of a run: 10^6 numbers stay within 5 V


class DaqRig(Rig):
    driver: ClassVar[type[BufferedSensor]]
    full_v: ClassVar[float]
    known: ClassVar[dict[str, Any]] = {}
    axes = 1

    def __init__(self) -> None:
        self.saturated = range(0)
        self.build_twin()
        self.sensor = self.build()

    @abstractmethod
    def build_twin(self) -> None: ...

    def build(self, **changes: Any) -> BufferedSensor:
        options = {"rate_hz": self.rate_hz} | self.known | changes
        model = self.driver.options_model
        return self.driver("sensor", model.model_validate(options), clock=self.clock, sleep=lambda s: self.sleep(s))

    def source(self, first: int, n: int) -> NDArray[np.float64]:
        k = np.arange(first, first + n)
        volts = np.where(np.isin(k, self.saturated), self.full_v, STEP_V * (k - 500_000))
        return np.column_stack([volts, *(STEP_V * (k - 400_000 + axis) for axis in range(1, self.axes))])

    def due_now(self) -> int:
        return self.due(self.t_s)

    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        mv = indications.astype(float)[:, 0]
        full = np.isclose(mv, 1e3 * self.full_v)
        numbers = np.where(full, self.saturated.start, np.round(mv / (1e3 * STEP_V)) + 500_000)
        return np.asarray(numbers.astype(np.int64))

    def saturate(self, first: int, last: int) -> None:
        self.saturated = range(first, last + 1)

    def close(self) -> None:
        self.sensor.close()


class Mcc172Rig(DaqRig):
    driver, full_v, rate_hz = Mcc172, 5.0 - 10.0 / 2**24, 3200.0

    def build_twin(self) -> None:
        self.twin = DaqhatsTwin(lambda first, n: self.source(first, n)[:, 0], self.due_now)

    def build_elsewhere(self) -> BufferedSensor:
        return self.build(address=3)

    def lose(self) -> None:
        self.twin.hardware_overrun = True

    def unplug(self) -> None:
        self.twin.present.clear()

    def replug(self) -> None:
        self.twin.present[0] = "MCC 172"


class TestMcc172(SensorContract):
    @pytest.fixture
    def rig(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[Mcc172Rig]:
        rig = Mcc172Rig()
        monkeypatch.setitem(sys.modules, "daqhats", rig.twin)  # type: ignore[arg-type]
        yield rig
        rig.close()

    def test_how_it_is_set(self, rig: Mcc172Rig) -> None:
        info = rig.build(iepe=False, channel=1, serial_number="LW1234").open()
        delay = f"delay delay_s={39 / info.nominal_rate_hz:.6g}"
        assert info.filters == ("highpass corner_hz=0.78 u_corner_pct=10", delay)  # of the board alone
        assert (info.kind, info.unit, info.serial_number) == ("MCC 172", "mV", "LW1234")
        assert info.settings == {
            "iepe": "0", "mV per unit": "1000", "rate_hz": "3200", "channel": "1", "board": "01ABCDEF",
            "board calibrated": "2026-02-03", "firmware": "1.03",
        }  # fmt: skip

    def test_another_board_at_the_address(self, rig: Mcc172Rig) -> None:
        rig.twin.present[0] = "MCC 118"
        with pytest.raises(IdentityError, match=r"MCC 172/address 0: Addr 0: Invalid board type"):
            rig.sensor.open()

    def test_a_setting_that_does_not_take(self, rig: Mcc172Rig) -> None:
        rig.twin.stuck["iepe"] = 0
        with pytest.raises(ConfigurationError, match="iepe is 0, not 1"):
            rig.sensor.open()

    def test_converters_that_never_synchronise(self, rig: Mcc172Rig) -> None:
        rig.twin.stuck["sync"] = 10**9
        with pytest.raises(DeviceLost, match=r"did not synchronise within 2\.0 s"):
            rig.sensor.open()

    def test_the_buffer_runs_over(self, rig: Mcc172Rig) -> None:
        rig.open()
        *_, before = rig.blocks(0.6)
        rig.sleep(4.0)  # at this rate the library keeps 10 000 samples, 3.1 s
        after = next(rig.blocks(0.1))
        assert after.flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert after.first_index == before.first_index + before.n
        (drop,) = rig.sensor.take_drops()
        assert (drop.count, drop.reason) == (10_000, "input overflow")

    def test_the_library_in_c_is_missing(self, rig: Mcc172Rig, monkeypatch: pytest.MonkeyPatch) -> None:
        def absent(address: int) -> None:  # noqa: ARG001 - signature of the library
            # The library raises plain Exception with this text
            raise Exception("daqhats shared library is not installed.")

        monkeypatch.setattr(rig.twin, "mcc172", absent)
        with pytest.raises(ConfigurationError, match="daqhats shared library is not installed"):
            rig.sensor.open()


class MccUsbRig(DaqRig):
    driver, full_v = MccUsb, 10.0 * (1 - 2.0**-15)

    def build_twin(self) -> None:
        self.twin = UldaqTwin(self.source, self.due_now)

    def build_elsewhere(self) -> BufferedSensor:
        return self.build(device="USB-1608")

    def lose(self) -> None:
        self.twin.fault = ULError.OVERRUN

    def unplug(self) -> None:
        self.twin.plugged = False

    def replug(self) -> None:
        self.twin.plugged = True


class MccUsbTriaxialRig(MccUsbRig):
    axes, known = 3, {"axes": 3}


class TestMccUsb(SensorContract):
    @pytest.fixture(params=[MccUsbRig, MccUsbTriaxialRig], ids=["one input", "three"])
    def rig(self, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[MccUsbRig]:
        rig = request.param()
        monkeypatch.setitem(sys.modules, "uldaq", rig.twin)
        yield rig
        rig.close()

    def test_how_it_is_set(self, rig: MccUsbRig) -> None:
        info = rig.open()
        assert (info.kind, info.unit, info.axes) == ("USB-1808X", "mV", rig.axes)
        assert (info.settings["board"], info.settings["range_v"]) == ("01F2A3B4", "10")
        assert info.filters == ()

    def test_three_inputs_keep_their_order(self, rig: MccUsbRig) -> None:
        rig.open()
        (block,) = rig.blocks(0.4)
        steps = np.diff(block.indications.astype(float), axis=1)
        expected = {1: [], 3: [100_001, 1]}[rig.axes]
        assert steps == pytest.approx(np.tile(1e3 * STEP_V * np.array(expected), (block.n, 1)))

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"range_v": 5}, "no range_v 5; it has BIP10VOLTS, BIP1VOLTS"),
            ({"first_channel": 8}, r"no input (8|10); in this mode the board has 8 inputs"),
            ({"rate_hz": 60_000}, "BAD_RATE"),
        ],
    )
    def test_what_the_board_cannot_do(self, rig: MccUsbRig, options: dict[str, Any], message: str) -> None:
        with pytest.raises(ConfigurationError, match=message):
            rig.build(**options).open()

    def test_a_current_that_the_board_has_not(self, rig: MccUsbRig) -> None:
        rig.twin.iepe = False
        assert rig.build(iepe=False).open().filters == ()
        with pytest.raises(ConfigurationError, match="iepe = true, but the board has no IEPE current"):
            rig.build(iepe=True).open()

    def test_a_rate_that_is_another(self, rig: MccUsbRig) -> None:
        rig.twin.rate_error = 0.02
        with pytest.raises(ConfigurationError, match="rate_hz 1000 is not available, the nearest rate is 1020 Hz"):
            rig.open()

    def test_a_scan_that_ends(self, rig: MccUsbRig) -> None:
        rig.open()
        list(rig.blocks(0.6))
        rig.twin.ended = True
        with pytest.raises(DeviceLost, match="the scan stopped"):
            list(rig.blocks(2.0))

    def test_which_board(self, rig: MccUsbRig) -> None:
        assert rig.build(device="1808").open().kind == "USB-1808X"
        with pytest.raises(
            DeviceLost, match="0 boards have this in their name, one is needed; connected: USB-1808X 01F2A3B4"
        ):
            rig.build(device="USB-2404").open()


class NiRig(DaqRig):
    driver, full_v, rate_hz = Ni, 5.0 * (1 - 2.0**-15), 2048.0
    known = {"channels": ["cDAQ1Mod1/ai0"]}  # noqa: RUF012

    def build_twin(self) -> None:
        self.twin = NidaqmxTwin(self.source, self.due_now)

    def build_elsewhere(self) -> BufferedSensor:
        self.twin.plugged = False
        return self.build()

    def lose(self) -> None:
        self.sleep(5.0)  # longer than the buffer of the library

    def unplug(self) -> None:
        self.twin.plugged = False

    def replug(self) -> None:
        self.twin.plugged = True


class TestNi(SensorContract):
    @pytest.fixture
    def rig(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[NiRig]:
        rig = NiRig()
        for name, module in rig.twin.modules.items():
            monkeypatch.setitem(sys.modules, name, module)
        yield rig
        rig.close()

    def test_how_it_is_set(self, rig: NiRig) -> None:
        info = rig.build(iepe_ma=2.1).open()
        assert (info.kind, info.unit, info.axes) == ("NI 9234", "mV", 1)
        assert (info.settings["board"], info.settings["range_mv"]) == ("1A2B3C", "5000")
        assert rig.twin.task is not None
        (added,) = rig.twin.task.inputs
        assert (added.ai_coupling.name, added.ai_excit_src.name) == ("AC", "INTERNAL")
        assert (added.ai_excit_voltage_or_current.name, added.ai_excit_val) == ("USE_CURRENT", pytest.approx(2.1e-3))
        assert info.filters == ("highpass corner_hz=0.6 u_corner_pct=50",)

    @pytest.mark.parametrize(("kind", "coupled"), [("NI 9234", False), ("NI 9233", True), ("PXIe-4497", True)])
    def test_devices_that_are_always_ac_coupled_say_so(self, rig: NiRig, kind: str, *, coupled: bool) -> None:
        rig.twin.kind = kind
        assert rig.open().filters == (("highpass corner_hz=0.6 u_corner_pct=50",) if coupled else ())

    def test_without_a_current_nothing_is_said_of_it(self, rig: NiRig) -> None:
        rig.open()
        assert rig.twin.task is not None
        assert not hasattr(rig.twin.task.inputs[0], "ai_excit_src")

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            (
                {"channels": ["Dev9/ai0"]},
                "NI channels Dev9/ai0: Physical channel specified does not exist. Status Code",
            ),
            ({"rate_hz": 60_000}, "not a supported value for this property. Status Code: -200077$"),
        ],
    )
    def test_what_the_device_cannot_do(self, rig: NiRig, options: dict[str, Any], message: str) -> None:
        sensor = rig.build(**options)
        with pytest.raises(ConfigurationError, match=message):
            sensor.open()
        assert rig.twin.task is not None
        assert rig.twin.task.closed

    def test_without_ni_daqmx(self, rig: NiRig) -> None:
        rig.twin.installed = False
        with pytest.raises(ConfigurationError, match="needs NI-DAQmx, which is not installed"):
            rig.open()


@pytest.mark.parametrize(
    ("driver", "options", "module", "extra"),
    [
        (Mcc172, {}, "daqhats", "mcc"),
        (MccUsb, {}, "uldaq", "mcc"),
        (Ni, {"channels": ["Dev1/ai0"]}, "nidaqmx", "ni"),
    ],
)
def test_without_the_library_it_says_what_to_install(
    driver: type[BufferedSensor], options: dict[str, Any], module: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ConfigurationError, match=rf"needs {module} \(fieldcal extras --install {extra}\) and "):
        driver("sensor", driver.options_model.model_validate(options)).open()


@pytest.mark.parametrize(
    ("driver", "options", "message"),
    [
        (Mcc172, {"rate_hz": 1000.0}, "1000 Hz is not 51200 Hz divided by 1 to 256; the nearest rate is 1003.92 Hz"),
        (Mcc172, {"rate_hz": 100.0}, "the nearest rate is 200 Hz"),
        (Ni, {"channels": ["Dev1/ai0", "Dev1/ai1"]}, "1 or 3 channels are needed, not 2"),
        (Ni, {"channels": ["ai0"]}, "each channel must be device/input"),
    ],
)
def test_options_that_cannot_work(driver: type[BufferedSensor], options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        driver.options_model.model_validate(options)
