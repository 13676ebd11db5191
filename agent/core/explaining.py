"""What explains the windows that stay held: each line of the uncertainty budget is set free in turn, before them.

The whole is then solved anew with the held windows. By how much chi-squared grows tells how well they agree with the
state if only this line is other than the state knows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import ValidationError

from agent.config import Channel
from agent.config.knowledge import AT_FIXED_MOUNT, PRIORS, StatedFields
from agent.core.gate import Gate, Limit
from agent.core.hypotheses import AN_UNKNOWN, DECISIVE
from calib.estimate.innovation import Innovation
from calib.estimate.nuisances import RESPONSE_U
from calib.estimate.quantities import ALL_RATES, OFFSET, RESPONSE, Kind, Quantity
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import PARAMETERS, Array, own_channels
from calib.state.state import State
from calib.windows.record import Record

# Standard uncertainty with which an unknown is set free, by its unit: beyond what a mistake would hardly reach.
FREE: Mapping[str, float] = {"rad": 0.2, "1": 0.2, "s": 0.02, "m/s2": 2.0, "Hz": 1.0, "1/K": 2e-3}
UNITS: Mapping[str, tuple[str, float]] = {
    "rad": ("deg", 180.0 / np.pi),
    "1": ("%", 100.0),
    "s": ("ms", 1e3),
    "1/K": ("%/K", 100.0),
}
ACROSS, MORE = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0), 2.0  # of the motion, as it is tried; times what is stated, at least
WORTH = 3.0  # an explanation that makes what chi-squared has beyond chance smaller by less explains nothing

COMPARE = "Compare devices and mount with the configuration"
NOT_AGREED = "no estimate can be put in force, since the windows do not agree on one change yet"


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """One line of the budget set free: chi-squared of the held windows, and its unknowns by their place in the state.

    `most` is the unknown of this line that changes most (over its uncertainty), `change` by how much. `unfit`: why S
    and Q that follow may not be put in force.
    """

    line: str
    chi2: float
    members: frozenset[int]
    most: Quantity
    change: float
    unfit: str = ""

    @property
    def score(self) -> float:
        """For comparison: the lowest is the best."""
        return self.chi2 + AN_UNKNOWN * len(self.members)


def explained(
    state: State, held: Sequence[Record], jump: Array, gate: Gate, channel: Channel, number: int | None
) -> str:
    """The explanation that fits the held windows best, for an operator.

    `jump` (12,) sets S and Q free, 0 where the windows tell nothing of them. `number` of the newest estimate from held
    windows that can be accepted, None if there is none.
    """
    alone = state.chi2_beside(held)
    before, by_chance = state.after(held, {}).chi2 - alone, sum(record.rows for record in held)
    sound = gate.limit(by_chance)
    said = (
        f"{len(held)} held windows contradict the state: chi-squared {before:.0f}, {sound:.0f} at most if it is right."
        if before > sound
        else f"{len(held)} held windows agree with what the state may have become since its last window (chi-squared "
        f"{before:.0f}, {sound:.0f} at most)."
    )
    lines = _lines(state, jump, channel.fixed_mount)
    tried = [_with(state, held, jump, gate, line, members, alone) for line, members in lines.items()]
    alike = _alike(tried, before, by_chance)
    if not alike:
        accept = "" if number is None or before > sound else f", or {_accepting(number)}"
        return f"{said} No known explanation fits them better. {COMPARE}{accept}"
    # Of those that fit alike, the one with the fewest unknowns: a mount that turned is also a change of all S.
    best = min(alike, key=lambda e: len(e.members))
    fits = "Best fits" if best.chi2 <= sound else "Nearest, though not within what chance allows, is"
    # Of another filter, only windows tell all that were made for it.
    helps = best.chi2 <= sound or best.most.kind is RESPONSE
    others = [_sentence(e, state.scale) for e in alike if e is not best and not best.members < e.members]
    as_well = f" As well fits: {'; '.join(others)}." if others else ""
    return (
        f"{said} {fits} {_sentence(best, state.scale)}: chi-squared {best.chi2:.0f}.{as_well} "
        f"{_remedy(best, state.scale, channel, number) if helps else best.unfit or COMPARE}"
    )


def motion_across(state: State, held: Sequence[Record]) -> str:
    """Whether motion across a uniaxial reference explains held windows at a fixed mount, for an operator; else "".

    The sensor feels this motion, and shows it along its other axes. Where more of it moves than is stated, each window
    asks for another change of S.
    """
    own, statements = held[-1], state.statements
    if statements.held_mps2 is None or own_channels(own.channels) != 1:
        return ""
    stated = statements.of(own.reference).transverse
    for u in (u for u in ACROSS if u >= MORE * stated):
        trial = state.stating(transverse=u)
        told = [trial.innovation(record) for record in held]
        if sum(one.statistic for one in told) <= sum(one.degrees_of_freedom for one in told):
            return (
                f"{len(held)} held windows agree with the state if the structure also moves across the reference, by "
                f"some {100.0 * u:.2g} % of what the reference measures; {100.0 * stated:.2g} % is stated. If it does, "
                f"set uncertainty.transverse_motion_pct to {100.0 * u:.2g}; the S that the reference tells is sound"
            )
    return ""


def _alike(tried: Sequence[Explanation], before: float, by_chance: int) -> list[Explanation]:
    """The explanations that fit as well as the best one, which is first; none where it is no better than none.

    `before`: chi-squared without an explanation; `by_chance`: that of sound windows.
    """
    found = sorted(tried, key=lambda e: e.score)
    if not found or before < found[0].score + DECISIVE or before - by_chance < WORTH * (found[0].chi2 - by_chance):
        return []
    return [e for e in found if e.score < found[0].score + DECISIVE]


def _lines(state: State, jump: Array, fixed_mount: bool) -> dict[str, list[int]]:
    """S, Q, and each line of the budget that the configuration states: which unknowns it has.

    At a fixed mount the mean output stands in the place of Q; the data cannot tell a lean of the mount from it.
    """
    quantities, lines, own = state.quantities, dict[str, list[int]](), {quantity.key for quantity in state.present()}
    for k, quantity in enumerate(quantities):
        if quantity.key not in own or quantity.name in ALL_RATES:
            continue
        if k >= len(jump):
            line = quantity.kind.source if _may_be_free(quantity.kind, fixed_mount) else ""
        else:
            line = quantity.kind.name if jump[k] > 0.0 else ""
        if line:
            lines.setdefault(line, []).append(k)
    if fixed_mount and OFFSET.name in lines:
        # A sensor that was turned on its mount has another mean output, too.
        turned = {line: members for line, members in lines.items() if quantities[members[0]].kind.unit == "rad"}
        lines |= {f"{line}, with its mean output": [*m, *lines[OFFSET.name]] for line, m in turned.items()}
    return lines


def _may_be_free(kind: Kind, fixed_mount: bool) -> bool:
    """Whether a kind of unknown besides S and Q has a line of the budget, and may be other than somebody states."""
    if kind is RESPONSE:
        return True
    leans = fixed_mount and "lean" in kind.loosened_by
    return bool(kind.source) and not leans and _setting(kind, fixed_mount) is not None


def _with(
    state: State, held: Sequence[Record], jump: Array, gate: Gate, line: str, members: Sequence[int], alone: float
) -> Explanation:
    quantities = state.quantities
    u = np.zeros(len(quantities))
    for k in members:
        kind = quantities[k].kind
        u[k] = jump[k] if k < len(jump) else RESPONSE_U if kind is RESPONSE else FREE[kind.unit]
    after = state.after(held, state.changes(u))
    chi2 = after.chi2 - alone
    if quantities[members[0]].kind is RESPONSE:
        hz, change = after.response_change(state)
        return Explanation(f"response at {hz:.3g} Hz", chi2, frozenset(members), quantities[members[0]], change)
    own = [quantities[k] for k in members if quantities[k].kind is quantities[members[0]].kind]
    moved = [_moved(state, after, quantity) for quantity in own]
    most = int(np.argmax([abs(change) / u_after for change, u_after in moved]))
    return Explanation(line, chi2, frozenset(members), own[most], moved[most][0], gate.refusal(after.result()))


def _moved(before: State, after: State, quantity: Quantity) -> tuple[float, float]:
    value, u = after.quantity(quantity.key)
    return value - before.quantity(quantity.key)[0], max(u, np.finfo(float).tiny)


def _sentence(explanation: Explanation, scale: float) -> str:
    kind, change = explanation.most.kind, explanation.change
    if kind is RESPONSE:  # by how much, only windows tell that were made for the new response
        return f"another {explanation.line} (S is {'larger' if change > 0.0 else 'smaller'} there)"
    if kind.in_output_unit:
        size = f"{change / scale:+.3g} m/s2" if kind is OFFSET else f"{100.0 * change / scale:+.3g} %"
    else:
        unit, factor = UNITS.get(kind.unit, (kind.unit, 1.0))
        size = f"{factor * change:+.3g} {unit}"
    return f"another {explanation.line} ({explanation.most.name} {size})"


def _remedy(best: Explanation, scale: float, channel: Channel, number: int | None) -> str:
    """What the operator can do; never what a command or the configuration would refuse."""
    kind, fixed_mount = best.most.kind, channel.fixed_mount
    accept = best.unfit or NOT_AGREED
    if number is not None and not best.unfit:
        accept = _accepting(number)
    if kind is OFFSET and fixed_mount:
        lean_deg = np.rad2deg(abs(best.change) / (scale * STANDARD_GRAVITY_MPS2))
        return f"A mount that leans by {lean_deg:.2g} deg does the same: level it. Otherwise: {accept}"
    if kind is RESPONSE:
        return (
            "A filter was set anew, or the mount came loose: set it back, tighten the mount, or state another "
            "prior.reference_frequency_hz, which begins the estimation again"
        )
    if "jump" in kind.loosened_by:
        return f"If the reference is sound: {accept}"
    setting = _setting(kind, fixed_mount)
    assert setting is not None  # see `_lines`
    least = f"{abs(best.change) / setting.convert(1.0):.2g}"
    settings = [field for field in setting.fields if _may_be(channel, field, float(least))]
    wider = f", or set {' or '.join(settings)} to {least} or more" if settings else ""
    return f"Correct it in the configuration{wider}"


def _accepting(number: int) -> str:
    return f"put the change in force: fieldcal command accept --sequence {number}"


def _may_be(channel: Channel, setting: str, value: float) -> bool:
    """Whether the configuration allows the value of a setting, as section.field."""
    section, field = setting.split(".")
    stated = getattr(channel, section)
    try:
        type(stated).model_validate(stated.model_dump() | {field: value})
    except ValidationError:
        return False
    return True


def _setting(kind: Kind, fixed_mount: bool) -> StatedFields | None:
    """Where the configuration states the kind's uncertainty; None where it does not."""
    return None if kind.prior is None else (AT_FIXED_MOUNT if fixed_mount else PRIORS).get(kind.prior.name)


def most_likely(innovation: Innovation, scale: float, limit: Limit) -> str:
    """The parameter whose change alone explains a window; `limit` is that of the gate."""
    size = np.abs(np.nan_to_num(innovation.score))
    p = int(np.argmax(size))
    if innovation.statistic - size[p] ** 2 > limit(innovation.degrees_of_freedom - 1.0):
        return "no change of a single parameter explains the window"
    change = innovation.score[p] / np.sqrt(innovation.information[p]) / scale
    told = f"{change:+.3g} m/s2" if p >= 9 else f"{100.0 * change:+.3g} %"
    return f"a change of {PARAMETERS[p]} by {told} explains it best ({size[p]:.1f} standard deviations)"
