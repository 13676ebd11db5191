"""Whether a window may change S and Q, and the status of the calibration that follows (docs/online.md)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from agent.config.gate import GateSettings
from agent.core.anchor import Anchor, Change
from calib.distributions import chi2_quantile
from calib.model import PARAMETERS, Calibration

Status = Literal["UNCALIBRATED", "COLLECTING", "VALID", "HELD", "RECALIBRATING", "INVALID"]
PROPOSALS_KEPT = 8  # an operator may answer one that newer ones have followed


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one window says: chi-squared of its innovation against the state's own covariance, and whether its
    excitation supports an update at all; if not, `reason` tells why."""

    t_s: float
    statistic: float
    degrees_of_freedom: float
    supported: bool = True
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Decision:
    """What becomes of the window.

    `take`: it goes into the state; `hold`: it is kept aside; `adopt`: all that were kept aside go in; `refuse`: it is
    left out. `in_force`: S and Q in force are now the state's. `propose`: publish `proposal` as an Estimate and give
    its number to `Gate.published`, several in their order. `held`: the newest windows to keep aside, at most
    `confirm_windows`, so that a wild one among them does not stand in the way for ever; the others are dismissed.
    """

    action: Literal["take", "hold", "adopt", "refuse"]
    status: Status
    reason: str
    numbers: dict[str, float] = field(default_factory=dict)
    in_force: bool = False
    proposal: Calibration | None = None
    held: int = 0

    @property
    def propose(self) -> bool:
        """There is a proposal to publish."""
        return self.proposal is not None


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What a command did: `refused` tells why it did nothing; `calibration` is in force now, where it changed."""

    status: Status
    reason: str
    refused: str = ""
    calibration: Calibration | None = None


class Gate:
    """The gate of one sensor. Its status follows from what it holds; `judge`, commands and events change that.

    In the order of precedence: INVALID (silent or lost), VALID on hold (rolled back), HELD (by an operator; or windows
    that contradict what is in force, or would lead too far), RECALIBRATING (a confirmed jump settles), VALID (something
    is in force), COLLECTING (windows taken, too little determined), UNCALIBRATED.
    """

    def __init__(self, settings: GateSettings, accepted: Calibration, in_force: Calibration | None = None) -> None:
        """`accepted`: by an operator, so a certificate or data sheet, or `Gate.accepted` of the run before; `in_force`:
        what was in force before, if anything.

        Raises ValueError where nothing can start from it: see Anchor, or `in_force` is beyond max_change.
        """
        self._settings = settings
        self._anchor = Anchor(settings, accepted)
        self._calibrated = in_force is not None  # something is in force
        if in_force is not None:
            beyond = self._anchor.change(in_force).reason
            if beyond:
                raise ValueError(f"what was in force before is {beyond}")
            self._anchor.learn(in_force)
        self._taken = False  # a window was consistent with what was known
        self._lost = False
        self._hold: Literal["", "operator", "rollback"] = ""
        self._held = 0  # windows kept aside
        self._agreeing = 0  # windows in a row that are consistent again, while some are kept aside
        self._settling = 0  # windows until a confirmed jump has settled
        self._proposals: list[tuple[int, Calibration]] = []  # oldest first; number 0: not yet published

    @property
    def status(self) -> Status:
        """CalibrationStatus as it follows from the state."""
        if self._lost:
            return "INVALID"
        if self._hold:
            return "VALID" if self._hold == "rollback" else "HELD"
        if self._held:
            return "HELD"
        if self._calibrated:
            return "RECALIBRATING" if self._settling else "VALID"
        return "COLLECTING" if self._taken else "UNCALIBRATED"

    @property
    def held(self) -> int:
        """Windows kept aside; a command or a lost sensor may have dismissed them."""
        return self._held

    @property
    def accepted(self) -> Calibration:
        """What changes are counted from; a later run that begins with it goes on counting."""
        return self._anchor.calibration

    # --- windows

    def judge(self, evidence: Evidence, candidate: Calibration, confirmed: Calibration | None = None) -> Decision:
        """One window. `candidate`: the state if it were taken; `confirmed`: where the windows kept aside lead, this one
        among them, if they agree with each other (worth computing from `confirm_windows` on, see Decision.held).
        """
        if not evidence.supported:
            return self._decision("refuse", evidence.reason)
        if self._hold:
            return self._decision("refuse", "on hold until an operator releases it")
        limit = chi2_quantile(1.0 - self._settings.false_holds, evidence.degrees_of_freedom)
        numbers = {"innovation_chi2": evidence.statistic, "innovation_chi2_threshold": limit}
        consistent = evidence.degrees_of_freedom <= 0 or evidence.statistic <= limit
        change = self._anchor.change(candidate)
        if consistent and not change.reason:
            return self._consistent(candidate, numbers | change.numbers)
        self._held, self._agreeing = min(self._held + 1, self._settings.confirm_windows), 0
        if confirmed is not None and self._held >= self._settings.confirm_windows:
            return self._confirmed(confirmed, numbers)
        if consistent:
            return self._beyond(candidate, change, numbers)
        return self._decision("hold", "a jump not yet confirmed: innovation beyond its threshold", numbers)

    def _consistent(self, candidate: Calibration, numbers: dict[str, float]) -> Decision:
        self._taken = True
        if self._held:
            self._agreeing += 1
            if self._agreeing >= self._settings.dismiss_windows:
                self._held = self._agreeing = 0
        elif self._settling:
            self._settling -= 1
        return self._accepted("take", candidate, "consistent with what was known", numbers)

    def _confirmed(self, confirmed: Calibration, numbers: dict[str, float]) -> Decision:
        change = self._anchor.change(confirmed)
        if change.reason:
            return self._beyond(confirmed, change, numbers)
        count, self._taken = self._held, True
        self._held, self._settling = 0, self._settings.settle_windows
        return self._accepted("adopt", confirmed, f"confirmed by {count} windows that agree", numbers | change.numbers)

    def _beyond(self, calibration: Calibration, change: Change, numbers: dict[str, float]) -> Decision:
        reason = f"{change.reason}; until an operator accepts it"
        return self._decision("hold", reason, numbers | change.numbers, proposal=calibration)

    def _accepted(
        self, action: Literal["take", "adopt"], calibration: Calibration, reason: str, numbers: dict[str, float]
    ) -> Decision:
        """The window goes into the state; whether S and Q in force follow is for the policy and what is determined."""
        # What a certificate tells well the data need not tell better.
        known = calibration.determined | self._anchor.known
        determined = int(np.count_nonzero(known))
        least = self._settings.least_determined or 1
        if not self._calibrated and determined < least:
            missing = [p for p, told in zip(PARAMETERS, known, strict=True) if not told]
            self._settling = 0  # nothing in force that could settle
            numbers |= {"determined": determined, "determined_threshold": least}
            return self._decision(action, f"not determined yet: {', '.join(missing)}", numbers)
        if self._settings.policy == "propose":
            return self._decision(action, f"{reason}; waits for an operator", numbers, proposal=calibration)
        if self._settings.policy == "observe":
            return self._decision(action, f"{reason}; only observed", numbers)
        self._calibrated = True
        self._anchor.learn(calibration)
        return self._decision(action, reason, numbers, in_force=True)

    def _decision(
        self,
        action: Literal["take", "hold", "adopt", "refuse"],
        reason: str,
        numbers: dict[str, float] | None = None,
        *,
        in_force: bool = False,
        proposal: Calibration | None = None,
    ) -> Decision:
        if self._settings.policy == "observe":
            proposal = None
        if proposal is not None:
            self._proposals.append((0, proposal))
        return Decision(action, self.status, reason, numbers or {}, in_force, proposal, self._held)

    def published(self, sequence: int) -> None:
        """The oldest proposal without a number went out as this Estimate."""
        k = next(k for k, (number, _) in enumerate(self._proposals) if not number)
        self._proposals[k] = (sequence, self._proposals[k][1])
        self._proposals = self._proposals[-PROPOSALS_KEPT:]

    # --- events and operators

    def lose(self, reason: str) -> Answer:
        """The sensor is silent or lost."""
        self._lost = True
        return Answer(self.status, reason)

    def regain(self, reason: str) -> Answer:
        """It speaks again; windows kept aside are from before, and dismissed."""
        self._lost = False
        self.dismiss()
        return Answer(self.status, reason)

    def dismiss(self) -> None:
        """Windows kept aside tell nothing more: what they were made with is another now."""
        self._held = self._agreeing = 0

    def hold(self, key: str) -> Answer:
        """An operator stops all change."""
        if self._hold:
            return self._refused("it is on hold already")
        self._hold = "operator"
        self._held = self._agreeing = 0
        return Answer(self.status, f"on hold by {key}")

    def release(self, key: str) -> Answer:
        """An operator lets changes through again."""
        if not self._hold:
            return self._refused("it is not on hold")
        self._hold = ""
        return Answer(self.status, f"released by {key}")

    def accept(self, sequence: int, key: str) -> Answer:
        """An operator puts an Estimate in force; it is the new anchor."""
        found = [calibration for number, calibration in self._proposals if number == sequence and number]
        if not found:
            waiting = ", ".join(str(number) for number, _ in self._proposals if number) or "none"
            return self._refused(f"no estimate {sequence} waits to be accepted; waiting: {waiting}")
        return self._put_in_force(found[0], f"estimate {sequence} accepted by {key}")

    def rollback(self, calibration: Calibration, key: str) -> Answer:
        """An operator puts an earlier calibration in force. It stays on hold: else the next windows would undo it."""
        answer = self._put_in_force(calibration, f"rolled back by {key}; on hold until released")
        if answer.refused:
            return answer
        self._hold = "rollback"
        return Answer(self.status, answer.reason, calibration=calibration)

    def _put_in_force(self, calibration: Calibration, reason: str) -> Answer:
        try:
            self._anchor = Anchor(self._settings, calibration)
        except ValueError as error:
            return self._refused(str(error))
        self._calibrated = True
        self._held = self._agreeing = self._settling = 0
        self._proposals = []
        return Answer(self.status, reason, calibration=calibration)

    def _refused(self, why: str) -> Answer:
        return Answer(self.status, "", refused=why)

    # --- state

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {
            "anchor": self._anchor.snapshot(),
            "calibrated": self._calibrated,
            "taken": self._taken,
            "lost": self._lost,
            "hold": self._hold,
            "held": self._held,
            "agreeing": self._agreeing,
            "settling": self._settling,
            "proposals": [{"sequence": number, **_plain(calibration)} for number, calibration in self._proposals],
        }

    def load(self, state: dict[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._anchor.load(state["anchor"])
        self._calibrated, self._taken, self._lost = state["calibrated"], state["taken"], state["lost"]
        self._hold, self._held = state["hold"], state["held"]
        self._agreeing, self._settling = state["agreeing"], state["settling"]
        self._proposals = [(proposal["sequence"], _calibration(proposal)) for proposal in state["proposals"]]


def _plain(calibration: Calibration) -> dict[str, Any]:
    return {
        "sensitivity": calibration.sensitivity.copy(),
        "offset": calibration.offset.copy(),
        "covariance": calibration.covariance.copy(),
        "determined": calibration.determined.copy(),
        "degrees_of_freedom": calibration.degrees_of_freedom,
        "method": calibration.method,
    }


def _calibration(state: dict[str, Any]) -> Calibration:
    return Calibration(**{name: state[name] for name in Calibration.__slots__})
