"""When a new S and Q may take the place of the old, and how readily drift is called so."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from agent.config.section import Section
from calib.estimate.drift import DriftSettings


class GateSettings(Section):
    """Acceptance. `max_change_...` is how far S and Q may go from what an operator last accepted, in all.

    A calibration that would go further waits for an operator's `accept`. `auto` puts accepted ones in force by itself;
    `propose` publishes them as estimates and waits for `accept`; `observe` only says what it sees. In both
    the state goes on unseen.
    """

    policy: Literal["auto", "propose", "observe"] = "auto"
    max_change_main_pct: Annotated[float, Field(gt=0, le=50, description="of each main sensitivity")] = 5.0
    max_change_transverse_pct: Annotated[float, Field(gt=0, le=50, description="of the mean main sensitivity")] = 3.0
    # At the defaults the transverse limit meets a common rotation first (1.7 deg); this one holds where that is wider.
    max_change_rotation_deg: Annotated[float, Field(gt=0, le=45)] = 3.0
    max_change_offset: Annotated[float | None, Field(gt=0, description="output unit; none: no limit")] = None
    largest_offset: Annotated[float | None, Field(gt=0, description="output unit; of the data sheet")] = None
    # A sound window in so many is held: at one window an hour, one a year.
    false_holds: Annotated[float, Field(gt=0, le=0.01, description="probability, a window")] = 1e-4
    # Held windows that agree, before a jump is believed: three could share one cause, a crane or a storm.
    confirm_windows: Annotated[int, Field(ge=2, le=100)] = 5
    # One quiet window is consistent with everything; so many in a row are needed to dismiss the held ones.
    dismiss_windows: Annotated[int, Field(ge=1, le=100)] = 3
    settle_windows: Annotated[int, Field(ge=1, le=1000, description="RECALIBRATING after a confirmed jump")] = 5
    # Left out: all twelve, at a fixed mount what its excitation can tell.
    least_determined: Annotated[
        int | None, Field(ge=1, le=12, description="parameters, before a first one is in force")
    ] = None


class DriftOptions(Section):
    """The sequential test for drift."""

    false_alarms_a_year: Annotated[float, Field(gt=0, le=100, description="a sensor, its 12 parameters together")] = 0.1
    windows_a_year: Annotated[float | None, Field(gt=0, description="none: as they come")] = None

    def settings(self) -> DriftSettings:
        """For calib.estimate.drift.DriftTest."""
        return DriftSettings(self.false_alarms_a_year, self.windows_a_year)
