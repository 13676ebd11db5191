"""Whether a window may change S and Q, and the status of the calibration that follows (docs/gate.md)."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from agent.config.gate import GateSettings
from agent.core.anchor import COVERAGE_FACTOR, MAIN, Anchor, AnchorDistance
from calib.distributions import chi2_quantile
from calib.estimate.axes import LEAST_S, unusable
from calib.model import PARAMETERS, Calibration

Limit = Callable[[float], float]  # from the degrees of freedom: the largest chi-squared of a consistent window
Status = Literal["UNCALIBRATED", "COLLECTING", "VALID", "HELD", "RECALIBRATING", "INVALID"]
PROPOSALS_KEPT = 8  # so that an operator can accept an estimate after newer ones were published


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the gate needs of one window: chi-squared of its innovation, with the covariance of the state.

    `dismisses`: if it fits, it may dismiss held ones. `enough`: with it the state has seen two windows, or 10 s, which
    a first calibration needs. `still`: a sentence on the directions in which nothing moved so far, "" where there is
    none.
    """

    t_s: float
    statistic: float
    degrees_of_freedom: float
    dismisses: bool = True
    enough: bool = True
    still: str = ""


@dataclass(frozen=True, slots=True)
class Decision:
    """What happens with the window.

    `take`: the state takes the window; `hold`: the window is held until further windows confirm it; `adopt`: the state
    takes all held windows; `refuse`: the window is not used. `in_force`: S and Q of the state are now in force.
    `propose`: publish `proposal` as an Estimate and give its number to `Gate.published`, several in their order.
    `held`: how many of the newest windows stay held, at most `confirm_windows`. Older ones are dismissed, so that a
    wrong window among them cannot prevent a confirmation for ever.
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
        """Whether there is a proposal to publish."""
        return self.proposal is not None


@dataclass(frozen=True, slots=True, eq=False)
class CommandEffect:
    """Effect of a command. `refused` says why it had none. `calibration` is in force now; None if nothing changed."""

    status: Status
    reason: str
    refused: str = ""
    calibration: Calibration | None = None


class Gate:
    """The gate of one sensor. `judge`, commands and events change its state, from which its status follows.

    The status is the first of these that applies: INVALID (the sensor is silent or lost), VALID on hold (after a
    rollback), HELD (an operator put it on hold, or held windows contradict the calibration in force or would change it
    beyond a limit), RECALIBRATING (the first windows after a confirmed jump), VALID (a calibration is in force),
    COLLECTING (windows were taken, but too few parameters are determined), UNCALIBRATED.
    """

    def __init__(self, settings: GateSettings, accepted: Calibration, in_force: Calibration | None = None) -> None:
        """`accepted`: the calibration that an operator accepted: from the certificate or the data sheet, or
        `Gate.accepted` of the previous run. `in_force`: the calibration that was in force before, if there was one.

        Raises ValueError if Anchor does, or if `in_force` is beyond max_change of `accepted`.
        """
        self._settings = settings
        self._anchor = Anchor(settings, accepted)
        self._calibrated = in_force is not None  # a calibration is in force
        if in_force is not None:
            beyond = self._anchor.change(in_force).reason
            if beyond:
                raise ValueError(f"the calibration that was in force before cannot be used: {beyond}")
            self._anchor.learn(in_force)
        self._taken = False  # a window was consistent with the state
        self._lost = False
        self._hold: Literal["", "operator", "rollback"] = ""
        self._held = 0  # number of held windows
        self._agreeing = 0  # consistent windows in a row since the last held one
        self._settling = 0  # further windows with the status RECALIBRATING
        self._proposals: list[tuple[int, Calibration]] = []  # oldest first; number 0: not yet published

    @property
    def calibrated(self) -> bool:
        """Whether a calibration is in force."""
        return self._calibrated

    @property
    def status(self) -> Status:
        """CalibrationStatus that follows from the state of the gate."""
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
    def on_hold(self) -> bool:
        """Whether an operator put the calibration on hold."""
        return bool(self._hold)

    @property
    def held(self) -> int:
        """Number of held windows. A command or the loss of the sensor dismisses them."""
        return self._held

    @property
    def accepted(self) -> Calibration:
        """The calibration from which changes are counted.

        A later run that begins with it continues to count from it.
        """
        return self._anchor.calibration

    # --- windows

    def limit(self, degrees_of_freedom: float) -> float:
        """The largest chi-squared with which a window is consistent; `false_holds` of the sound windows have more."""
        return chi2_quantile(1.0 - self._settings.false_holds, degrees_of_freedom)

    def judge(self, evidence: Evidence, candidate: Calibration, confirmed: Calibration | None = None) -> Decision:
        """Decide on one window. `candidate`: the calibration if the state takes the window. `confirmed`: the
        calibration if the state takes all held windows with this one; None if they do not agree with each other, or if
        they are fewer than `confirm_windows` (see Decision.held).
        """
        if self._hold:
            return self._decision(
                "refuse", "an operator put the calibration on hold; no window is used until an operator releases it"
            )
        limit = self.limit(evidence.degrees_of_freedom)
        numbers = {"innovation_chi2": evidence.statistic, "innovation_chi2_threshold": limit}
        consistent = evidence.degrees_of_freedom <= 0 or evidence.statistic <= limit
        change = self._anchor.change(candidate)
        if consistent and not change.reason:
            return self._consistent(candidate, numbers | change.numbers, evidence)
        self._held, self._agreeing = min(self._held + 1, self._settings.confirm_windows), 0
        if confirmed is not None and self._held >= self._settings.confirm_windows:
            return self._confirmed(confirmed, numbers)
        if consistent:
            return self._beyond(candidate, change, numbers)
        return self._decision(
            "hold", "the window contradicts the calibration; held until further windows confirm a jump", numbers
        )

    def _consistent(self, candidate: Calibration, numbers: dict[str, float], evidence: Evidence) -> Decision:
        self._taken = True
        if self._held:
            self._agreeing += evidence.dismisses
            if self._agreeing >= self._settings.dismiss_windows:
                self._held = self._agreeing = 0
        elif self._settling:
            self._settling -= 1
        said = "consistent with the calibration so far"
        return self._accepted("take", candidate, said, numbers, evidence)

    def _confirmed(self, confirmed: Calibration, numbers: dict[str, float]) -> Decision:
        change = self._anchor.change(confirmed)
        if change.reason:
            return self._beyond(confirmed, change, numbers)
        count, self._taken = self._held, True
        self._held, self._settling = 0, self._settings.settle_windows
        return self._accepted(
            "adopt",
            confirmed,
            f"a jump was confirmed by {count} windows that agree with each other",
            numbers | change.numbers,
        )

    def _beyond(self, calibration: Calibration, change: AnchorDistance, numbers: dict[str, float]) -> Decision:
        if wrong := self.refusal(calibration):
            return self._decision("hold", f"{change.reason}; {wrong}", numbers | change.numbers)
        reason = f"{change.reason}; held until an operator accepts it"
        return self._decision("hold", reason, numbers | change.numbers, proposal=calibration)

    def _accepted(
        self,
        action: Literal["take", "adopt"],
        calibration: Calibration,
        reason: str,
        numbers: dict[str, float],
        evidence: Evidence | None = None,
    ) -> Decision:
        """The state takes the window. Policy and determined parameters decide whether S and Q in force change too."""
        # The data need not determine a parameter that the certificate states well enough.
        known = calibration.determined | self._anchor.known
        determined = int(np.count_nonzero(known))
        least = self._settings.least_determined or 1
        if not self._calibrated and determined < least:
            missing = [p for p, told in zip(PARAMETERS, known, strict=True) if not told]
            self._settling = 0  # RECALIBRATING is only for a calibration in force
            numbers |= {"determined": determined, "determined_threshold": least}
            still = "" if evidence is None or not evidence.still else f"; {evidence.still}"
            lacking = f"parameters not determined: {', '.join(missing)}{still}"
            return self._decision(action, f"not in force yet, {lacking}", numbers)
        enough = evidence is None or evidence.enough
        if not self._calibrated and (lacking := _lacking(calibration, known, enough=enough)):
            self._settling = 0
            return self._decision(action, f"not in force yet: {lacking}", numbers)
        if self._settings.policy == "propose":
            return self._decision(
                action,
                f"{reason}; not in force until an operator accepts it (policy propose)",
                numbers,
                proposal=calibration,
            )
        if self._settings.policy == "observe":
            return self._decision(action, f"{reason}; not put in force (policy observe)", numbers)
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
        """The oldest proposal without a number was published as the Estimate with this number."""
        k = next(k for k, (number, _) in enumerate(self._proposals) if not number)
        self._proposals[k] = (sequence, self._proposals[k][1])
        self._proposals = self._proposals[-PROPOSALS_KEPT:]

    def refusal(self, calibration: Calibration) -> str:
        """Why a calibration must not be proposed to an operator, see Anchor.refusal; "" if it can be."""
        return self._anchor.refusal(calibration)

    def number_of(self, proposal: Calibration) -> int | None:
        """The number with which an operator can accept a proposal; None if it has none."""
        same = (number for number, own in self._proposals if np.array_equal(own.covariance, proposal.covariance))
        return next(same, 0) or None

    def anchor_at(self, accepted: Calibration, in_force: Calibration) -> str:
        """Count changes from another calibration, which the configuration states now. Returns "" if that is done.

        If the calibration in force is beyond a limit of it, nothing is done, and the return value says which limit.
        """
        anchor = Anchor(self._settings, accepted)
        if self._calibrated:
            if beyond := anchor.change(in_force).reason:
                return beyond
            anchor.learn(in_force)
        self._anchor = anchor
        return ""

    # --- events and operators

    def lose(self, reason: str) -> CommandEffect:
        """The sensor is silent or lost."""
        self._lost = True
        return CommandEffect(self.status, reason)

    def regain(self, reason: str) -> CommandEffect:
        """The sensor sends data again. Held windows are older than the interruption and are dismissed."""
        self._lost = False
        self.dismiss()
        return CommandEffect(self.status, reason)

    def dismiss(self) -> None:
        """Dismiss the held windows, because the device with which they were made was replaced or interrupted."""
        self._held = self._agreeing = 0

    def hold(self, key: str) -> CommandEffect:
        """An operator puts the calibration on hold: no window is used."""
        if self._hold:
            return self._refused("the calibration is on hold already")
        self._hold = "operator"
        self._held = self._agreeing = 0
        return CommandEffect(self.status, f"put on hold by {key}")

    def release(self, key: str) -> CommandEffect:
        """An operator ends the hold: windows are used again."""
        if not self._hold:
            return self._refused("the calibration is not on hold")
        self._hold = ""
        return CommandEffect(self.status, f"released by {key}")

    def accept(self, sequence: int, key: str) -> CommandEffect:
        """An operator puts an Estimate in force. It becomes the new anchor."""
        found = [calibration for number, calibration in self._proposals if number == sequence and number]
        if not found:
            waiting = ", ".join(str(number) for number, _ in self._proposals if number) or "none"
            return self._refused(f"estimate {sequence} cannot be accepted; estimates that can be: {waiting}")
        return self._put_in_force(found[0], f"estimate {sequence} accepted by {key}")

    def rollback(self, calibration: Calibration, key: str) -> CommandEffect:
        """An operator puts an earlier calibration in force, on hold, because the next windows would undo the
        rollback."""
        answer = self._put_in_force(calibration, f"rolled back by {key}; on hold until an operator releases it")
        if answer.refused:
            return answer
        self._hold = "rollback"
        return CommandEffect(self.status, answer.reason, calibration=calibration)

    def believe(self, calibration: Calibration) -> None:
        """The configuration states this calibration as an earlier one of the device: it is in force."""
        self._calibrated = True
        self._anchor.learn(calibration)

    def _put_in_force(self, calibration: Calibration, reason: str) -> CommandEffect:
        try:
            self._anchor = Anchor(self._settings, calibration)
        except ValueError as error:
            return self._refused(str(error))
        self._calibrated = True
        self._held = self._agreeing = self._settling = 0
        self._proposals = []
        return CommandEffect(self.status, reason, calibration=calibration)

    def _refused(self, why: str) -> CommandEffect:
        return CommandEffect(self.status, "", refused=why)

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
            "proposals": [{"sequence": number, **fields_of(calibration)} for number, calibration in self._proposals],
        }

    def load(self, state: dict[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._anchor.load(state["anchor"])
        self._calibrated, self._taken, self._lost = state["calibrated"], state["taken"], state["lost"]
        self._hold, self._held = state["hold"], state["held"]
        self._agreeing, self._settling = state["agreeing"], state["settling"]
        kept = [dict(proposal) for proposal in state["proposals"]]
        self._proposals = [(proposal.pop("sequence"), Calibration(**proposal)) for proposal in kept]


def _lacking(calibration: Calibration, known: NDArray[np.bool_], *, enough: bool) -> str:
    """What a first calibration lacks, besides the number of its parameters; "" if nothing."""
    if not known[MAIN].any():
        return "no main sensitivity (Sxx, Syy, Szz) is determined"
    if wrong := unusable(calibration, COVERAGE_FACTOR):
        return wrong[0]
    return "" if enough else f"two windows, or {LEAST_S:g} s, are needed to see whether the data agree with each other"


def fields_of(calibration: Calibration) -> dict[str, Any]:
    """The fields of a calibration, for a snapshot; its arrays are copies."""
    return {name: copy(getattr(calibration, name)) for name in Calibration.__slots__}
