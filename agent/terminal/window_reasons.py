"""Why a window is refused or held: what each reason of the running agent means, what a person can do, and which
settings matter.

The one table of remedies: the line `next:` and docs/reference/reasons.md are made from it. The sentences themselves are
made where the reason is seen; docs/architecture.md lists these files. `{}` stands for a name or a number.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

from calib.excitation.window_verdict import RULES
from calib.excitation.windows import CALM
from calib.signal.response import UNSETTLED

AS_BEFORE = "check that mount, sensor and reference are as before"
_FIELD = re.compile(r"\{[^}]*\}")
_WITHIN = "(?:(?!; ).)+?"  # a name or a number, and no other part of a reason
_SENTENCES = {name: _FIELD.sub("{}", sentence) for name, _, sentence in RULES}
_HANDS = "keep hands and cables off the sensor while it stands in a position, and let it warm up"
_LONGER = "let the sensor stay longer in each position"
_MOTION = "wait for more motion, or make it: that of the reference is hardly above its noise"
_RANGE = "make the motion smaller, or set a larger range: the sensor reaches the end of its range"
_FOLLOW = "fasten sensor and reference to the same part, and compare their axes with the configuration"


@dataclass(frozen=True)
class WindowReason:
    """One reason, or several with the same remedy. `sentences` are their beginnings, alone or after another reason and
    a semicolon; `do` is what helps; `settings` are those of a channel that matter, as `section.setting`."""

    sentences: tuple[str, ...]
    means: str
    do: str
    settings: tuple[str, ...] = ()

    @cached_property
    def _patterns(self) -> list[re.Pattern[str]]:
        patterns = (_WITHIN.join(re.escape(part) for part in sentence.split("{}")) for sentence in self.sentences)
        return [re.compile(f"(?:^|; ){pattern}") for pattern in patterns]

    def places(self, reason: str) -> Iterator[tuple[int, int]]:
        """Where in a reason each sentence stands that it has, and how long this sentence is in the table."""
        for sentence, pattern in zip(self.sentences, self._patterns, strict=True):
            for found in pattern.finditer(reason):
                yield found.start(), len(sentence)


@dataclass(frozen=True)
class Stage:
    """What is looked at together. Windows meet the stages, and the reasons in each, in the order of the table."""

    title: str
    reasons: tuple[WindowReason, ...]


RAW = Stage(
    "The samples as they came",
    (
        WindowReason(
            ("{}: {} is {}, too large to compute with",),
            "a device sent a number that no sensor indicates, as a garbled line does",
            "check the line to the device that the reason names: it sent a number that nothing can be computed from",
        ),
        WindowReason(
            ("{}: {} is stuck at {}", "{}: {} only toggles between {} and {}"),
            "an output does not change where a sound one would; no window of this time is used",
            "look at the device that the reason names: one of its outputs does not change; check its wiring, then its "
            "range and supply",
        ),
        WindowReason(
            ("{}: its driver gave the same samples twice",),
            "a burst is the same as the one before it, sample by sample",
            "check that no other program reads the device that the reason names, then its driver",
        ),
    ),
)
REFERENCE = Stage(
    "The certificate of the reference",
    (
        WindowReason(
            ("the certificate is of serial number {}, but the reference has serial number {}",),
            "the reference that is connected is not the one of the certificate; no window beside it is used",
            "connect the reference of the certificate, or state the certificate of the one that is connected",
            ("certificate.serial_number", "certificate.file"),
        ),
    ),
)
POSITION = Stage(
    "The position, where the configuration states `positions`",
    (
        WindowReason(
            ("less than {} s of samples, which is too short to find the position",),
            "gravity tells the position only from the mean of so many seconds",
            _LONGER,
        ),
        WindowReason(
            ("the sensor stands at none of the stated positions",),
            "the mean output does not fit S g + Q at any stated position",
            "turn the sensor to a stated position, or correct the positions in the configuration",
            ("positions", "uncertainty.angle_deg", "prior.sensitivity"),
        ),
        WindowReason(
            ("the sensor stands at {} or at {}: the odds are",),
            "two stated positions are too much alike for what is known of S and Q",
            "state positions that differ more in the direction of gravity, or S and Q with smaller uncertainties",
            ("positions", "prior.u_offset_mps2", "prior.u_main_pct"),
        ),
        WindowReason(
            ("the mean acceleration is {} m/s2, gravity is {} m/s2",),
            "with the S and Q that are known, the mean output is not as large as gravity",
            "compare range, unit and sensitivity of the sensor with the configuration: at rest it must show gravity",
            ("prior.sensitivity", "prior.u_main_pct", "prior.u_offset_mps2", "gravity_mps2"),
        ),
        WindowReason(
            ("gravity shows theta = {} deg, more than 90 deg: change the sign of static_sign",),
            "the sensor's z axis points the other way than the configuration states",
            "change the sign of static_sign",
            ("static_sign",),
        ),
        WindowReason(
            ("gravity gives only u(alpha) = {} deg and u(theta) = {} deg",),
            "the angles follow from gravity less well than 10 deg: Q is hardly known, or z is nearly vertical",
            "incline the clamp more, or state Q with a smaller uncertainty: gravity tells the angles too badly",
            ("clamp_theta_deg", "prior.u_offset_mps2"),
        ),
        WindowReason(
            ("gravity shows theta = {} deg, {} deg is stated",),
            "the clamp is inclined by another angle than the configuration states",
            "set the clamp to the stated theta, or correct clamp_theta_deg",
            ("clamp_theta_deg", "uncertainty.angle_deg"),
        ),
        WindowReason(
            ("the sensor slipped at {}: its mean changed by {} m/s2 without a turn",),
            "the sensor moved and stands in the same position, so that its stated angle is no longer right",
            "fasten the sensor, and turn it to a position again: it slipped",
            ("uncertainty.angle_deg", "uncertainty.offset_mps2"),
        ),
    ),
)
SAMPLES = Stage(
    "The samples of both devices",
    (
        WindowReason(
            ("no samples of {}",),
            "nothing came from the sensor in this time",
            "check power and cable of the device that the reason names: nothing came from it",
            ("late_horizon_s",),
        ),
        WindowReason(
            ("no samples of the reference {}",),
            "nothing came from the reference in this time; S and Q stay as they are",
            "check power and cable of the reference: nothing came from it",
            ("reference", "late_horizon_s"),
        ),
        WindowReason(
            ("{} has {}, this pose needs {}",),
            "the device has another number of axes than the configuration expects",
            "connect a device with as many axes as the configuration states, or correct the positions or rotation",
            ("reference", "poses", "rotation"),
        ),
        WindowReason(
            ("{}: its sample numbers and arrivals do not make a clock",),
            "sample numbers jump at will, so that nobody can tell when a sample was taken",
            "check the sample numbers that the device sends, or its driver: no time follows from them",
        ),
        WindowReason(
            ("the reference {} was at the end of its range",),
            "the motion was larger than the reference can measure",
            "make the motion smaller, or set a larger range: the reference reaches the end of its range",
        ),
        WindowReason(
            ("{} % of the samples of {} are missing",),
            "more samples are missing than can be filled",
            "find what loses samples: a line or bus that is too slow, a loose cable, or a busy computer; "
            "`fieldcal doctor --measure 5` measures each device",
            ("late_horizon_s",),
        ),
        WindowReason(
            ("the samples of sensor and reference do not overlap in time",),
            "there are not two samples of the sensor beside which the reference is known",
            "check both devices for gaps: in this time they did not send together",
        ),
    ),
)
WINDOW = Stage(
    "The window",
    (
        WindowReason((_SENTENCES["points"],), "too few samples are left for a regression", _LONGER, ("window_s",)),
        WindowReason(
            (_SENTENCES["reference_rms_mps2"],),
            "the reference hardly moves, or its cable or supply is off",
            _MOTION,
            ("certificate.noise_mps2", "certificate.sensitivity"),
        ),
        WindowReason(
            (_SENTENCES["stuck_axes"],),
            "an output has one value in the whole window",
            "look at the sensor: an axis always indicates the same value",
        ),
        WindowReason((_SENTENCES["clipped_points"],), "the motion is larger than the sensor's range", _RANGE),
        WindowReason(
            (_SENTENCES["coherence"],),
            "less than half of what the sensor shows is what the reference shows: another part, other axes, a loose "
            "mount, a dead channel of the reference, or time stamps that lie apart",
            _FOLLOW,
            ("reference", "rotation", "uncertainty.lag_s"),
        ),
        WindowReason(
            (_SENTENCES["drift_mps2"],), "the offset changes: it was turned, touched, or is warming up", _HANDS
        ),
        WindowReason(
            (_SENTENCES["step_mps2"],),
            "the sensor moved within the window: no angle is right for all of it",
            _HANDS,
            ("uncertainty.angle_deg", "uncertainty.offset_mps2", "guard_s"),
        ),
        WindowReason(
            (_SENTENCES["nonlinearity_pct"],),
            "the sensor shows less, or more, where the motion is strong",
            "fasten the sensor better: it slips or rattles where the motion is strong",
        ),
        WindowReason(
            (_SENTENCES["left_out_pct"],), "more samples than the limit are knocks", "keep knocks away from the sensor"
        ),
        WindowReason(
            (CALM,),
            "the reference moves before or after, and hardly in this window; this alone is no fault",
            "wait for more motion, or make it: the reference is calm",
        ),
        WindowReason(
            ("the sensor is never at rest here",),
            "nothing rests long enough in a position without motion",
            "put the sensor where nothing moves it",
        ),
        WindowReason(
            ("too few points: {} are independent in the band of the motion",),
            "the motion is slow, and a window of this length holds too little of it",
            "wait for faster motion, or make the windows longer (window_s): slow motion tells little in a short time",
            ("window_s", "band_hz"),
        ),
        WindowReason(
            ("the motion is slow: it makes {} cycles here",),
            "the window holds less than a turn to and fro",
            "turn the sensor to and fro in each window, or make the windows longer (window_s)",
            ("window_s",),
        ),
        WindowReason(
            ("the sensor was at the end of its range",),
            "the sensor itself says so, also where no sample looks clipped",
            _RANGE,
        ),
    ),
)
ESTIMATE = Stage(
    "The estimation",
    (
        WindowReason(
            (UNSETTLED,),
            "sensor and reference respond too differently within the band of the motion; only before the response is "
            "known",
            "use motion at lower frequencies, limit the band (band_hz), or state the filters of both instruments",
            ("band_hz", "prior.filters", "certificate.filters"),
        ),
        WindowReason(
            ("a lag of {} ms explains the window, but the lag is stated as {} ms",),
            "only another lag than the configuration allows explains the window; it follows a reason of coherence or "
            "contradiction",
            "if the time stamps may lie so far apart, set uncertainty.lag_s to what the reason says; else look at the "
            "clocks of both devices",
            ("uncertainty.lag_s", "certificate.lag_s"),
        ),
        WindowReason(
            ("{} has not been connected in this run",),
            "the agent does not know yet which sensor this is, or nothing states its sensitivity (the status says so)",
            "look at the status of the sensor: it was not opened yet, or nothing states its sensitivity",
            ("prior.sensitivity",),
        ),
        WindowReason(
            ("an operator put the calibration on hold",),
            "an operator commanded `hold` or `rollback`",
            "`fieldcal command hold --release` lets the agent use windows again",
        ),
        WindowReason(
            ("a fault of the program, not of the data",),
            "the program failed at this window; the next ones are judged as usual",
            "report the fault, with the line of the log that names file and line; the agent goes on",
        ),
    ),
)
HELD = Stage(
    "Held windows",
    (
        WindowReason(
            ("the window contradicts the calibration",),
            "S and Q of the state do not explain the window, by more than its uncertainties. What follows names the "
            "parameter whose change alone would",
            AS_BEFORE,
            ("gate.confirm_windows", "gate.dismiss_windows", "gate.false_holds"),
        ),
        WindowReason(
            ("S or Q changed by more than max_change",),
            "with this window S or Q is further from what an operator last accepted than the agent may go by itself",
            f"{AS_BEFORE}; if the change is real, accept the estimate",
            (
                "gate.max_change_main_pct", "gate.max_change_transverse_pct", "gate.max_change_rotation_deg",
                "gate.max_change_offset", "gate.largest_offset",
            ),
        ),
        WindowReason(
            ("output {} is dead", "{} is {}, but outputs {} and {} have {}: the reference's channel along {} is dead"),
            "no estimate is proposed, because one of the outputs would be dead",
            "check the wiring of the output that the reason names",
        ),
        WindowReason(
            (
                "det S is negative", "output {} the samples of another output", "the largest element of {} is off the "
                "diagonal", "{}: the sensor indicates the opposite of the motion there",
            ),
            "no estimate is proposed, because axes would be exchanged or inverted that were not so before",
            "set plug, axes and signs back to what they were",
            ("rotation", "poses"),
        ),
        WindowReason(
            (
                "S or Q is not finite", "the estimate gives no number for", "no main sensitivity (Sxx, Syy, Szz) is "
                "determined", "U({}) is {}, above the largest main sensitivity", "the calibration cannot be used as a "
                "start",
            ),
            "no estimate is proposed, because S or Q would be of no use",
            "wait for more motion or further positions: the held windows do not tell S and Q well enough",
        ),
    ),
)  # fmt: skip
REFUSED = (RAW, REFERENCE, POSITION, SAMPLES, WINDOW, ESTIMATE)


def known(reason: str) -> WindowReason | None:
    """The row of the table for the reason of a window; None where the table has none.

    Where a reason has several parts, the last of them says most; of two sentences that begin alike, the longer one.
    """
    every = [one for stage in (*REFUSED, HELD) for one in stage.reasons]
    found = [(place, k) for k, one in enumerate(every) for place in one.places(reason)]
    return every[max(found)[1]] if found else None
