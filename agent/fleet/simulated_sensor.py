"""What happens to a simulated sensor, round by round, and the results that the agent makes of it.

A round is one window. All that is odd begins in the round of BEGINS, so that rounds may be a second apart or ten days.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Sequence
from typing import Any, Literal

import msgspec
import numpy as np

from agent.core.events import CalibrationUpdate, Estimate, Result, StatusChange
from agent.fleet.simulated_channel import (
    GRAVITY_MPS2,
    NOISE_MPS2,
    NOMINAL,
    SimulatedChannel,
    WindowTruth,
    identity_with,
)
from calib.model import Array

Behaviour = Literal[
    "sound", "drifting", "stepped", "held", "leaning", "dying", "silent", "cloned", "hostile"
]  # fmt: skip
# The first round in which it is so. Of a gateway: the round in which it stops (silent), or its twin begins (cloned).
BEGINS: dict[Behaviour, int] = {
    "sound": 0, "drifting": 3, "stepped": 4, "held": 5, "leaning": 5, "dying": 3, "hostile": 3,
    "silent": 4, "cloned": 4,
}  # fmt: skip
VARIANTS = 5  # of each behaviour and name: what differs between two sensors is drawn so many times
DRIFT_A_ROUND = 2e-3  # of one main sensitivity
STEP, STEP_TO_BE_HELD = 0.03, 0.09  # of one main sensitivity; a gateway puts at most 5 % in force by itself
LEAN_DEG = 6.0  # of the mount with the sensor and its reference
NOISE_GROWS, NOISY_ROUNDS, DEAD_ROUNDS = 3.0, 3, 1  # of a dying sensor: its noise, then one output, then all
NO_ANSWER = "[Errno 121] Remote I/O error"  # what Linux says of an I2C device that does not answer
WALK, WALK_MPS2 = 1e-4, 1e-3  # of sensitivities, and of offsets, over a day; they go with the square root of time
DAY_NS = 86_400e9
RUN_ID = "simulated"
NUMBER = re.compile(r"(?<=--sequence )\d+")  # of an estimate, in the words for an operator


class Story:
    """A sensor to which something happens. The rounds are asked for in their order; the newest one may be asked again.

    `seed`: two stories of the same name, behaviour, seed and times give the same results.
    """

    def __init__(self, name: str, behaviour: Behaviour, seed: Sequence[int]) -> None:
        self.name, self.behaviour = name, behaviour
        self._seed = list(seed)
        self._random = np.random.default_rng([*seed, 0])
        self._axis = int(self._random.integers(3))  # of the main sensitivity, or of the output, that changes
        self._sign = 1.0 if self._random.random() < 0.5 else -1.0
        main, other = 0.01 * self._random.normal(size=3), 0.005 * self._random.normal(size=(3, 3))
        self._sensitivity = np.eye(3) + np.where(np.eye(3) > 0, np.diag(main), other)
        self._offset_mps2 = 0.1 * self._random.normal(size=3)
        self._channel: SimulatedChannel | None = None
        self._rounds, self._t_utc_ns = 0, 0
        self._newest: list[Result] = []
        self._last = 0  # number of the last result
        self._since_utc_ns: int | None = None
        self._mutex = threading.Lock()

    def results(self, number: int, t_utc_ns: int) -> list[Result]:
        """The results of round `number` (from 0), at about this time, numbered from 1 on in the whole story.

        Raises ValueError where this round is not the next one, nor the newest.
        """
        with self._mutex:
            if number == self._rounds:
                self._newest = self._numbered(self._next(number, t_utc_ns))
                self._rounds, self._t_utc_ns = number + 1, t_utc_ns
            if number != self._rounds - 1:
                raise ValueError(f"round {number} was asked for, but round {self._rounds} is the next one")
            return self._newest

    def newest_truth(self) -> dict[str, Any]:
        """What is true in the newest round; `sensitivity` and `offset` in counts, `change_pct` of `parameter`."""
        number = max(self._rounds - 1, 0)
        truth, begun = self.truth(number), self.behaviour != "sound" and number >= BEGINS[self.behaviour]
        return {
            "behaviour": self.behaviour, "begun": begun, "since_utc_ns": self._since_utc_ns,
            "parameter": self._parameter if begun else "", "change_pct": 100.0 * self._change(number),
            "lean_deg": LEAN_DEG if begun and self.behaviour == "leaning" else 0.0,
            "sensitivity": truth.sensitivity.tolist(), "offset": truth.offset.tolist(),
        }  # fmt: skip

    def truth(self, number: int) -> WindowTruth:
        """What is true in a round; of the newest one, as sensitivity and offset have wandered until then."""
        since, gravity, noise, dead = number - BEGINS[self.behaviour], GRAVITY_MPS2, NOISE_MPS2, None
        sensitivity = self._sensitivity.copy()
        sensitivity[self._axis] *= 1.0 + self._change(number)
        if self.behaviour == "leaning" and since >= 0:
            gravity = _leaned(gravity, np.deg2rad(LEAN_DEG), self._axis)
        if self.behaviour == "dying" and since >= 0:
            noise *= NOISE_GROWS ** min(since + 1, NOISY_ROUNDS)
            dead = self._axis if since >= NOISY_ROUNDS else None
        return WindowTruth(NOMINAL * sensitivity, NOMINAL * self._offset_mps2, gravity, noise, dead)

    @property
    def _parameter(self) -> str:
        return f"S{'xyz'[self._axis] * 2}" if self.behaviour in ("drifting", "stepped", "held") else ""

    def _change(self, number: int) -> float:
        """By how much the main sensitivity, and with it the row of S, has changed, relative."""
        since = number - BEGINS[self.behaviour] + 1
        if since <= 0:
            return 0.0
        size = {"drifting": DRIFT_A_ROUND * since, "stepped": STEP, "held": STEP_TO_BE_HELD}.get(self.behaviour, 0.0)
        return self._sign * size

    def _next(self, number: int, t_utc_ns: int) -> list[Result]:
        found: list[Result] = []
        if self._channel is None:
            self._channel = SimulatedChannel(self.name, [*self._seed, 1], t_utc_ns)
            found = self._channel.opened(t_utc_ns)
        else:
            self._wander((t_utc_ns - self._t_utc_ns) / DAY_NS)
        since = number - BEGINS[self.behaviour]
        if self.behaviour != "sound" and since == 0:
            self._since_utc_ns = t_utc_ns
        if self.behaviour == "hostile" and since >= 0:
            return [_hostile(self.name, t_utc_ns)] if since == 0 else []
        if self.behaviour == "dying" and since >= NOISY_ROUNDS + DEAD_ROUNDS:
            return self._channel.lost(t_utc_ns, NO_ANSWER) if since == NOISY_ROUNDS + DEAD_ROUNDS else []
        return [*found, *self._channel.window(self.truth(number), t_utc_ns)]

    def _numbered(self, results: Sequence[Result]) -> list[Result]:
        assert self._channel is not None  # it was opened in the first round
        numbered = self._channel.number(results, self._last + 1, RUN_ID)
        self._last += len(numbered)
        return numbered

    def _wander(self, days: float) -> None:
        size = np.sqrt(max(days, 0.0))
        self._sensitivity = self._sensitivity + WALK * size * np.diag(self._random.normal(size=3))
        self._offset_mps2 = self._offset_mps2 + WALK_MPS2 * size * self._random.normal(size=3)


class SimulatedSensor:
    """A story under a serial number and with numbers of its own; several sensors may share one."""

    def __init__(self, story: Story, serial_number: str) -> None:
        self.story, self.name = story, story.name
        self._identity = identity_with(serial_number)
        self._estimates: dict[str, str] = {}  # their own numbers by those of the story, which words name

    def results(self, number: int, t_utc_ns: int, first_sequence: int) -> list[Result]:
        """The results of round `number` (from 0), numbered from `first_sequence`."""
        made = self.story.results(number, t_utc_ns)
        return [self._relabel(result, t_utc_ns, first_sequence + k) for k, result in enumerate(made)]

    def truth(self) -> dict[str, Any]:
        """What is true of the sensor in the newest round, for comparison with what is said of it."""
        return {"sensor": self.name, "identity": self._identity, **self.story.newest_truth()}

    def _relabel(self, result: Result, t_utc_ns: int, sequence: int) -> Result:
        own: dict[str, Any] = {"t_utc_ns": t_utc_ns, "sequence": sequence}
        if isinstance(result, CalibrationUpdate):
            own["identity"] = self._identity
        elif isinstance(result, Estimate):
            self._estimates[str(result.sequence)] = str(sequence)
            own["calibration"] = msgspec.structs.replace(result.calibration, t_utc_ns=t_utc_ns, identity=self._identity)
        elif isinstance(result, StatusChange):
            own["reason"] = NUMBER.sub(lambda found: self._estimates.get(found[0], found[0]), result.reason)
        return msgspec.structs.replace(result, **own)


def _leaned(gravity_mps2: Array, angle_rad: float, axis: int) -> Array:
    """Gravity in the frame of a mount that has turned about its axis x, or y where `axis` is odd."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    turn = [[1, 0, 0], [0, cos, -sin], [0, sin, cos]] if axis % 2 == 0 else [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]
    return np.asarray(np.array(turn) @ gravity_mps2)


def _hostile(sensor: str, t_utc_ns: int) -> StatusChange:
    """What a person with bad intentions might let a gateway say."""
    reason = "<img src=x onerror=alert(3)>\x1b[2J\u202e'; DROP TABLE result; --"
    return StatusChange(run_id="", sequence=0, sensor=sensor, t_utc_ns=t_utc_ns, status="HELD", before="VALID",
                        reason=reason)  # fmt: skip
