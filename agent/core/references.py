"""The references of a channel that are connected: their identities, and whether their certificates belong to them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.config import Channel
from agent.config.knowledge import Certificate
from agent.core.estimation import Estimation
from agent.core.identity import identity_of, not_certified
from calib.state.state import DATED


class References:
    """The first reference of a channel has place 0, the second one, if there is one, place 1.

    `not_certified` says by place why a reference may not be used, "" if it may.
    """

    def __init__(self, channel: Channel) -> None:
        self._beside = channel.by_reference
        self.identities = [""] * len(self._beside)
        self.not_certified = [""] * len(self._beside)

    def identify(self, device: str, info_json: str) -> tuple[str, str, str]:
        """A reference was opened. Returns the identities of the device that was there before and of the present one,
        and why that may not be used, "" if it may."""
        place = [beside.reference for beside in self._beside].index(device)
        before, self.identities[place] = self.identities[place], identity_of(info_json)
        self.not_certified[place] = not_certified(info_json, self._beside[place].certificate)
        return before, self.identities[place], self.not_certified[place]

    def meet(self, estimation: Estimation | None) -> bool:
        """Tell the estimation which references are connected, and what their certificates state now.

        Returns whether the calibration in force changed.
        """
        changed = False
        for place, beside in enumerate(self._beside):
            if estimation is not None and self.identities[place] and not self.not_certified[place]:
                certificate = beside.certificate
                own = self.identities[place], certificate.calibrated, certificate.sensitivity
                changed |= estimation.meet(*own, place)
        return changed

    def certificate_of(self, reference: str) -> Certificate | None:
        """The certificate of a reference by its name in a state; None if it is not connected."""
        identity, _, calibrated = reference.partition(DATED)
        for place, beside in enumerate(self._beside):
            same_date = "" in (calibrated, beside.certificate.calibrated) or calibrated == beside.certificate.calibrated
            if identity and identity == self.identities[place] and same_date:
                return beside.certificate
        return None

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {"references": list(self.identities), "not_certified": list(self.not_certified)}

    def load(self, state: Mapping[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self.identities, self.not_certified = list(state["references"]), list(state["not_certified"])
