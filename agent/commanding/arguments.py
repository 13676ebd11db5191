"""The arguments of each command and their limits."""

from __future__ import annotations

import math
from typing import Annotated, Literal, get_args

import msgspec

from agent.commanding.refusal import Refused
from agent.config.strict_json import strict

Verb = Literal["pose", "hold", "accept", "rollback"]
VERBS: tuple[Verb, ...] = get_args(Verb)
Vector = tuple[float, float, float]
Sequence = Annotated[int, msgspec.Meta(ge=1, le=2**63 - 1)]

# A length that differs from 1 by more than this (0.1 %) is a typing error, not rounding.
UNIT_TOLERANCE = 1e-3
# Limits for the length of a gravity vector, m/s2. On the ground gravity is 9.764 to 9.834.
GRAVITY_MPS2 = (9.7, 9.9)


class PoseArguments(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """The sensor's position from now on: clamp angles, or the motion's direction, or gravity alone (a rest)."""

    theta_deg: Annotated[float, msgspec.Meta(ge=-90, le=90)] | None = None
    alpha_deg: Annotated[float, msgspec.Meta(ge=-360, le=360)] | None = None
    direction: Vector | None = None
    gravity_mps2: Vector | None = None
    position: Annotated[str, msgspec.Meta(pattern=r"\A[A-Za-z0-9][A-Za-z0-9_.-]{0,62}\Z")] | None = None

    def __post_init__(self) -> None:
        if (self.theta_deg is None) != (self.alpha_deg is None):
            raise ValueError("theta_deg and alpha_deg must be given together")
        if self.theta_deg is not None and (self.direction or self.gravity_mps2):
            raise ValueError("give theta_deg and alpha_deg, or direction and gravity_mps2, not both")
        if self.theta_deg is None and self.direction is None and self.gravity_mps2 is None:
            raise ValueError("needs theta_deg and alpha_deg, or direction, or gravity_mps2")
        if self.direction is not None and abs(math.hypot(*self.direction) - 1) > UNIT_TOLERANCE:
            length = math.hypot(*self.direction)
            raise ValueError(f"direction {list(self.direction)} is not a unit vector: its length is {length:.4g}")
        if self.gravity_mps2 is not None:
            length, (least, most) = math.hypot(*self.gravity_mps2), GRAVITY_MPS2
            if not least < length < most:
                raise ValueError(f"gravity_mps2 has the length {length:.4g} m/s2, not between {least} and {most}")


class Hold(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Keep the calibration in force unchanged; with `release` this ends."""

    release: bool = False


class Accept(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Bring the estimate with this sequence number into force."""

    sequence: Sequence


class Rollback(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Bring the calibration with this sequence number into force again."""

    sequence: Sequence


Arguments = PoseArguments | Hold | Accept | Rollback
_DECODERS: dict[Verb, msgspec.json.Decoder[Arguments]] = {
    "pose": msgspec.json.Decoder(PoseArguments),  # made during the import, as agent.delivery.record says
    "hold": msgspec.json.Decoder(Hold),
    "accept": msgspec.json.Decoder(Accept),
    "rollback": msgspec.json.Decoder(Rollback),
}


def parse_arguments(verb: Verb, text: bytes | str) -> Arguments:
    """Read the arguments of a command from JSON. Raises Refused, which names the field."""
    try:
        strict(text)
        return _DECODERS[verb].decode(text)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise Refused("out of limits", f"{verb}: {error}") from None
