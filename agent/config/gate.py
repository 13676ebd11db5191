"""Settings of the gate, which decides whether new S and Q come into force, and of the drift test."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from agent.config.section import Section
from calib.drift.drift import DriftSettings
from calib.model import PARAMETERS

MAX_CHANGE_OFFSET_MPS2 = 0.5  # as much as a mount that leans by 3 deg
FIXED_MOUNT_LEAST = 4  # parameters: three of Q, and one of S; without turning, all twelve may never be


class GateSettings(Section):
    """The gate. `max_change_...` limits the whole change of S and Q since an operator last accepted a calibration.

    A calibration beyond a limit comes into force only after an operator's `accept`. Within the limits, policy `auto`
    puts new calibrations in force, `propose` publishes them as estimates and waits for `accept`, and `observe` only
    reports the windows. In all three the estimation goes on.
    """

    policy: Literal["auto", "propose", "observe"] = "auto"
    max_change_main_pct: Annotated[float, Field(gt=0, le=50, description="of each main sensitivity")] = 5.0
    max_change_transverse_pct: Annotated[float, Field(gt=0, le=50, description="of the mean main sensitivity")] = 3.0
    # With the defaults, a common rotation exceeds the transverse limit first (at 1.7 deg). This limit acts if that one
    # is made wider.
    max_change_rotation_deg: Annotated[float, Field(gt=0, le=45)] = 3.0
    max_change_offset: Annotated[float | None, Field(gt=0, description="output unit; left out: no limit")] = None
    largest_offset: Annotated[float | None, Field(gt=0, description="output unit; from the data sheet")] = None
    # Probability that the gate holds a good window: 1e-4 is one a year, with one window an hour.
    false_holds: Annotated[float, Field(gt=0, le=0.01, description="probability for each window")] = 1e-4
    # So many held windows must agree before a jump counts as real. Three could have one cause: a crane, or a storm.
    confirm_windows: Annotated[int, Field(ge=2, le=100)] = 5
    # So many consistent windows in a row dismiss the held ones. One is not enough: a window with little motion is
    # consistent with every calibration.
    dismiss_windows: Annotated[int, Field(ge=1, le=100)] = 3
    settle_windows: Annotated[
        int, Field(ge=1, le=1000, description="number of windows with the status RECALIBRATING after a confirmed jump")
    ] = 5
    # A jump is confirmed by five windows. With one window an hour, HELD that lasts longer does not end by itself.
    explain_after_s: Annotated[
        float,
        Field(ge=60, le=3.2e7, description="after so long in HELD, and again, say what explains the held windows"),
    ] = 21_600.0
    # If left out: all twelve; at a fixed mount, as many as its excitation can determine.
    least_determined: Annotated[
        int | None, Field(ge=1, le=12, description="determined parameters that the first calibration needs")
    ] = None

    def filled(self, scale: float, *, fixed_mount: bool) -> GateSettings:
        """The settings with what they leave open: a jump of the offset, and how much a first calibration needs.

        `scale` is the sensor's output unit per m/s2.
        """
        filled: dict[str, float] = {}
        if self.max_change_offset is None:
            filled["max_change_offset"] = MAX_CHANGE_OFFSET_MPS2 * scale
        if self.least_determined is None:
            filled["least_determined"] = FIXED_MOUNT_LEAST if fixed_mount else len(PARAMETERS)
        return self.model_copy(update=filled)


class DriftOptions(Section):
    """The two tests for drift: of the windows one by one, and of net changes over a week to four years."""

    false_alarms_a_year: Annotated[float, Field(gt=0, le=100, description="per sensor, of all its tests together")] = (
        0.1
    )
    windows_a_year: Annotated[float | None, Field(gt=0, description="left out: counted from the windows")] = None

    @property
    def of_one_test(self) -> float:
        """False alarms a year of each of the two tests."""
        return self.false_alarms_a_year / 2.0

    def settings(self) -> DriftSettings:
        """The settings for calib.drift.drift.DriftTest."""
        return DriftSettings(self.of_one_test, self.windows_a_year)
