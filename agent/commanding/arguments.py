"""What may stand in a command, by verb, with its limits."""

from __future__ import annotations

import math
from typing import Annotated, Literal, get_args

import msgspec

from agent.commanding.refusal import Refused

Verb = Literal["pose", "hold", "accept", "rollback"]
VERBS: tuple[Verb, ...] = get_args(Verb)
Vector = tuple[float, float, float]
Sequence = Annotated[int, msgspec.Meta(ge=1, le=2**63 - 1)]

# A direction that is off by more is a typing error, no rounding (0.1 % of its length).
UNIT_TOLERANCE = 1e-3
# Gravity on the ground, m/s2: 9.764 to 9.834. What an ideal sensor reads at rest has this length.
GRAVITY_MPS2 = (9.7, 9.9)


class Pose(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """How the sensor stands from now on: clamp angles, or the motion's direction, or gravity alone (a rest)."""

    theta_deg: Annotated[float, msgspec.Meta(ge=-90, le=90)] | None = None
    alpha_deg: Annotated[float, msgspec.Meta(ge=-360, le=360)] | None = None
    direction: Vector | None = None
    gravity_mps2: Vector | None = None
    position: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,62}$")] | None = None

    def __post_init__(self) -> None:
        if (self.theta_deg is None) != (self.alpha_deg is None):
            raise ValueError("theta_deg and alpha_deg go together")
        if self.theta_deg is not None and (self.direction or self.gravity_mps2):
            raise ValueError("theta_deg and alpha_deg exclude direction and gravity_mps2")
        if self.theta_deg is None and self.direction is None and self.gravity_mps2 is None:
            raise ValueError("needs theta_deg and alpha_deg, or direction, or gravity_mps2")
        if self.direction is not None and abs(math.hypot(*self.direction) - 1) > UNIT_TOLERANCE:
            raise ValueError(f"direction {list(self.direction)} is not a unit vector")
        if self.gravity_mps2 is not None:
            length, (least, most) = math.hypot(*self.gravity_mps2), GRAVITY_MPS2
            if not least < length < most:
                raise ValueError(f"gravity_mps2 has the length {length:.4g}, not {least} to {most}")


class Hold(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Change nothing until released; `release` ends it."""

    release: bool = False


class Accept(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Bring the estimate with this number into force."""

    sequence: Sequence


class Rollback(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Bring the calibration with this number into force again."""

    sequence: Sequence


Arguments = Pose | Hold | Accept | Rollback
_KINDS: dict[Verb, type[Arguments]] = {"pose": Pose, "hold": Hold, "accept": Accept, "rollback": Rollback}


def parse_arguments(verb: Verb, text: bytes | str) -> Arguments:
    """The arguments of a command from JSON. Raises Refused naming the field."""
    try:
        return msgspec.json.decode(text, type=_KINDS[verb])
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise Refused("out of limits", f"{verb}: {error}") from None
