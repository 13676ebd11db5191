"""What the watch of a site says today: a verdict for each sensor and gateway, with size, U and date, and what cannot
be seen.

One step at an unknown time is asked for (a drift appears as a step that begins in its middle). The tests of all
sensors, directions, gateways, noise floors and times share one rate of false alarms, by Bonferroni's inequality.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.distributions import NORMAL, student_quantile
from calib.model import Array
from calib.site_watch import frequencies
from calib.site_watch.frequencies import FrequencyChange
from calib.site_watch.scatter import Blocks
from calib.site_watch.steps import PRIOR_DEGREES, TERMS, Steps
from calib.site_watch.together import ALL, DIRECTIONS, SENSITIVITIES, JointChange, jointly, median
from calib.site_watch.watch import VISIT, SiteWatch, pooled
from calib.site_watch.witnesses import Witness, gravity, noise, self_test

FALSE_ALARMS_PER_YEAR = 0.5  # of a whole site, at most, where the model of the scatter holds
LOOKS_PER_YEAR = 1000.0  # independent looks of a test: a new one each day for steps of a few days, fewer for older ones
FEWEST_DAYS = 21  # that teach the norm of a sensor
FEWEST_SINCE = 3  # days after a step, before it is told
WALK_PER_ROOT_DAY = 3e-5  # standard uncertainty of the sensitivity's own walk after a day: 0.06 % in a year
COVERAGE = 2.0
APART_MISFIT = 1.1  # factor of the squares by which bands differ, for what the norm does not fit over seasons
# Part of the variance of a sensor that all of its gateway share: they are neighbours, and shapes move smoothly along a
# structure. Assumed; the simulated bridge has up to 0.15, the more the nearer they stand (docs/site-watch.md).
PART_SHARED = 0.25
LEAST_NOISE = 0.03  # of the amplitude of the noise, for its change to be told: a sensitivity changes the noise alike
# Of an angle, relative: days tell means of cross powers and of log amplitudes, and a turn acts in each hour by itself.
U_TURN = 0.1
FEWEST_BANDS = 3  # for bands to be called alike
NAMES = ("sensitivity of x", "sensitivity of y", "sensitivity of z", "sensitivity of x, y and z",
         "turn about x", "turn about y", "turn about z")  # fmt: skip
MONTH_DAYS = 30  # after a change, of which the least detectable one is told
VISITS_DAYS = 400  # for which what a visit found says how far all sensors have changed alike
LONGEST_DAYS = 365  # of the norm, over which the walk counts
LEAST_VARIANCE = 0.2  # of a channel's variance, that a step leaves
SUSPECTED = "sensitivity", "one of two", "turn"  # verdicts of a sensor by itself that witnesses are asked of
FOLLOW = *SUSPECTED, "sensor or structure", "gateway"  # what may follow from a change of a frequency
# Of the change of a sensor: by how much quiet and loud hours must differ in it to be told as the excitation. Damage
# that was simulated had up to 0.75 in an axis that hardly moves, at 3.1 u or less; sources had 0.5 to 2.
PART_CONTRASTED = 0.25
EVIDENCE_DROP = 4.0  # of the squared statistic: begins within it are not told apart (2 standard deviations)


@dataclass(frozen=True, slots=True, eq=False)
class SensorVerdict:
    """A verdict of a sensor or gateway.

    `kind`: none, learning, sensitivity, one of two, turn, noise, structure, sensor or structure, gateway, excitation,
    clock.
    `what`: in words. `size`, `U`: change of the log of the sensitivity (relative change of the amplitude of the noise),
    or angle in rad; expanded by COVERAGE. `since`, `earliest`, `latest`: days since 1970; -1 where none is told.
    `statistic`: size over its standard uncertainty, or a normal equivalent. `direction`: index in
    calib.site_watch.together.DIRECTIONS of a sensitivity or turn; -1 for others. `hz`: the natural frequency that has
    changed; NaN for others.
    `witnesses`: of a sensitivity or turn, the structure first.
    """

    kind: str
    what: str = ""
    size: float = 0.0
    U: float = np.inf
    since: int = -1
    earliest: int = -1
    latest: int = -1
    statistic: float = 0.0
    direction: int = -1
    witnesses: tuple[Witness, ...] = ()
    hz: float = np.nan


NOTHING = SensorVerdict("none")


@dataclass(frozen=True, slots=True, eq=False)
class SiteVerdicts:
    """The verdicts of a site on day `day`.

    `sensors` (n), `gateways` {number: verdict}, `site`. `least_detectable` (n, 3): relative change of the
    sensitivity of x, y, z that is found 30 days after it in half of the cases. `days` (n,): days that teach the
    norm. `seen_degc` (n, 2): range of temperature in the norm. `outside`: today's temperature is beyond what the
    sensor's norm has seen. `common`: change that all sensors share, against those beside a reference, or else by what
    visits found; None without such. `hidden`: a common change below this size is not seen (relative). `frequencies`:
    natural frequencies that have changed, the surest first; bands in which one lies tell nothing else.
    """

    day: int
    sensors: list[SensorVerdict]
    gateways: dict[int, SensorVerdict]
    site: SensorVerdict
    least_detectable: Array
    days: Array
    seen_degc: Array
    outside: NDArray[np.bool_]
    common: SensorVerdict | None
    hidden: float
    limit: float
    frequencies: tuple[SensorVerdict, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Tests:
    """The joint test at each begin of a step (k,). `apart` (k, n): do the bands of a sensor change differently, as a
    normal deviate; `bands` (k, n): that tell of a sensor."""

    begins: list[int]
    joint: JointChange
    apart: Array
    bands: Array

    def dated(self, squared: Array) -> tuple[int, tuple[int, int, int]]:
        """As `dated`, at the begins of these tests."""
        return dated(self.begins, squared)


def dated(begins: list[int], squared: Array) -> tuple[int, tuple[int, int, int]]:
    """Index of the likeliest begin; its day, and the first and last day that are not told apart from it."""
    best = int(np.argmax(squared))
    near = np.flatnonzero(squared >= squared[best] - EVIDENCE_DROP)
    first, last = int(near[0]), int(near[-1])  # between these and the next begins none is kept
    earliest = begins[first - 1] + 1 if first else begins[0]
    latest = begins[last + 1] - 1 if last + 1 < len(begins) else begins[last]
    return best, (begins[best], earliest, latest)


def limit_of(sensors: int, gateways: int, per_year: float = FALSE_ALARMS_PER_YEAR) -> float:
    """Standard deviations that no sound test may exceed, with `per_year` false alarms of the whole site."""
    tests = sensors * (len(DIRECTIONS) + 1 + 3) + gateways
    return -NORMAL.inv_cdf(0.5 * per_year / (tests * LOOKS_PER_YEAR))


def result(watch: SiteWatch, known_u: Array | None = None) -> SiteVerdicts:
    """The verdicts of today. `known_u` (n,): relative standard uncertainty of the sensitivity of each sensor that
    stands beside a reference; inf or NaN for the others."""
    n = watch.shape[0]
    anchored = np.zeros(n, dtype=bool) if known_u is None else np.isfinite(known_u)
    limit = limit_of(n, len(set(watch.gateway.tolist())))
    days, sensors = _begun(watch)
    gateways: dict[int, SensorVerdict] = {}
    site, common, least = NOTHING, None, np.full((n, 3), np.inf)
    changed = _frequencies(watch)
    tests = examined(watch, frequencies.moved_bands(watch.band_hz, [one for one, _ in changed]))
    if tests is not None:
        floors = _noise(watch, limit)
        for i in range(n):
            if sensors[i].kind == "none" and not anchored[i]:
                sensors[i] = _sensor(tests, i, limit, floors[i])
        sensors = [_excited(watch, tests, i, told, limit) for i, told in enumerate(sensors)]
        _of_two(tests, sensors)
        gateways = _gateways(watch, tests, sensors, limit)
        _follow_frequencies([told for _, told in changed], sensors, gateways)
        site = max(_structure(tests, sensors), *(told for _, told in changed), NOTHING, key=lambda one: one.statistic)
        if known_u is not None and anchored.any():
            common = _common_change(tests, known_u[anchored], anchored)
        sensors = [witnessed(watch, i, told) for i, told in enumerate(sensors)]
        least = _least_change(watch, tests, limit)
    _clocks(watch, sensors)
    common = common or _common_by_visits(watch)
    outside = (watch.degc < watch.seen_degc[:, 0]) | (watch.degc > watch.seen_degc[:, 1])
    hidden = common.U if common is not None else np.inf
    return SiteVerdicts(
        watch.day,
        sensors,
        gateways,
        site,
        least,
        days,
        watch.seen_degc.copy(),
        outside,
        common,
        hidden,
        limit,
        tuple(told for _, told in changed),
    )


def _begun(watch: SiteWatch) -> tuple[Array, list[SensorVerdict]]:
    """The days (n,) of each sensor since its last visit, and `learning` where they are too few."""
    days = watch.steps.days.reshape(watch.shape).max(axis=(1, 2))
    return days, [NOTHING if d >= FEWEST_DAYS + FEWEST_SINCE else SensorVerdict("learning") for d in days]


def _least_change(watch: SiteWatch, tests: Tests, limit: float) -> Array:
    """(n, 3) that equals the limit a month after it."""
    month = int(np.argmin([abs(watch.day - begin + 1 - MONTH_DAYS) for begin in tests.begins]))
    return np.asarray(limit * tests.joint.u[month, :, :3])


def _begins(watch: SiteWatch) -> list[int]:
    """Which begins of steps have enough days before and since."""
    begins = watch.steps.begins
    return [k for k, begin in enumerate(begins)
            if watch.day - begin + 1 >= FEWEST_SINCE and begin - begins[0] >= FEWEST_DAYS]  # fmt: skip


def _frequencies(watch: SiteWatch) -> list[tuple[FrequencyChange, SensorVerdict]]:
    """Natural frequencies that have changed, the surest first."""
    which = _begins(watch)
    if not which:
        return []
    found = frequencies.joined(watch, which, (FEWEST_DAYS, FEWEST_SINCE), LONGEST_DAYS)
    told = []
    for one in frequencies.changed(watch, found, frequencies.limit_of(watch.shape[1], LOOKS_PER_YEAR)):
        _, dates = dated([watch.steps.begins[k] for k in which], one.squared)
        what = f"natural frequency near {one.hz:.3g} Hz, at {one.sensors[0]} of {one.sensors[1]} sensors"
        verdict = SensorVerdict("structure", what, one.size, COVERAGE * one.u, *dates, one.statistic, hz=one.hz)
        told.append((one, verdict))
    return told


def _follow_frequencies(
    changed: list[SensorVerdict], sensors: list[SensorVerdict], gateways: dict[int, SensorVerdict]
) -> None:
    """What sensors and gateways show since the day of a change of a frequency follows from it: the skirts of a mode
    reach far, so it is not told of them."""

    def follows(told: SensorVerdict) -> bool:
        return told.kind in FOLLOW and any(
            one.earliest - FEWEST_SINCE <= told.since <= one.latest + FEWEST_SINCE for one in changed
        )

    sensors[:] = [NOTHING if follows(told) else told for told in sensors]
    for number in [number for number, told in gateways.items() if follows(told)]:
        del gateways[number]


def examined(watch: SiteWatch, without: NDArray[np.bool_] | None = None) -> Tests | None:
    """The joint test at all begins with enough days before and since; None where there is none. `without` (B,): bands
    that do not count."""
    begins, shape = watch.steps.begins, watch.shape
    which = _begins(watch)
    if not which:
        return None
    size, information, since = (part.reshape(-1, *shape) for part in watch.steps.step(which))
    days, at = watch.steps.days.reshape(shape), [begins[k] for k in which]
    counts = (since >= FEWEST_SINCE) & (days - since >= FEWEST_DAYS)
    if without is not None:
        counts &= ~without[:, None]
    variance, week = _without(watch.variance(), size, information, days), watch.band_scatter.without_steps(at)
    information = np.where(counts, information / (variance * week), 0.0)
    # What a band does by itself for weeks is no damage.
    doubt = np.maximum(watch.band_scatter.today() / week, 1.0)
    ages = np.array([watch.day - begin + 1 for begin in at], dtype=float)
    before = np.minimum([begin - begins[0] for begin in at], LONGEST_DAYS)
    walk = WALK_PER_ROOT_DAY * np.sqrt((ages + before) / 3.0)  # of the difference of two means
    inflation = watch.taught() * watch.days_scatter.over(watch.day, at)
    joint = jointly(size, information, *watch.norm_since(which, size), inflation, walk, doubt)
    apart = _apart(joint)
    bands = (information[..., :3] > 0.0).any(axis=-1).sum(axis=-1)
    return Tests(at, joint, apart, bands)


def _without(variance: Array, size: Array, information: Array, days: Array) -> Array:
    """The variance without what a step explains: the step is no scatter."""
    freedom = np.maximum(days, 1.0) + PRIOR_DEGREES
    return np.asarray(np.maximum(variance - size**2 * information / freedom, LEAST_VARIANCE * variance))


def _apart(joint: JointChange) -> Array:
    """How much the bands of each sensor differ from any change of its sensitivities and any turn, (k, n).

    What most sensors show, such as days that the norm does not fit, is taken as scatter.
    """
    squares, freedom = joint.squares, joint.freedom
    f = np.maximum(freedom, 1).astype(float)
    site = np.where(joint.pair, 1.0, median(np.where(freedom > 0, squares / f, np.nan), axis=1))
    ratio = squares / f / (APART_MISFIT * np.maximum(site, 1.0))[:, None]
    deviate = (np.cbrt(ratio) - (1.0 - 2.0 / (9.0 * f))) / np.sqrt(2.0 / (9.0 * f))
    return np.asarray(np.where(freedom > 0, deviate, -np.inf))


def _sensor(tests: Tests, i: int, limit: float, noise: SensorVerdict) -> SensorVerdict:
    """The verdict of one sensor by itself."""
    statistic, apart = tests.joint.statistic[:, i], tests.apart[:, i]
    direction = int(np.argmax(np.abs(statistic).max(axis=0)))
    z = float(np.abs(statistic[:, direction]).max())
    sure = np.abs(statistic[:, direction]) >= min(z, limit)
    best, dates = tests.dated(np.where(sure, tests.joint.evidence[:, i, direction], 0.0) ** 2)
    if apart.max() > limit and (z <= limit or apart[best] > limit):
        worst, dates = tests.dated(np.maximum(apart, 0.0) ** 2)
        return SensorVerdict(
            "sensor or structure", "its bands change differently", 0.0, np.inf, *dates, float(apart[worst])
        )
    if z > limit:
        kind, what = "sensitivity" if direction <= ALL else "turn", NAMES[direction]
        if tests.joint.pair[best] and kind == "sensitivity":
            kind, what = "one of two", f"{what}, or that of the other sensor against it; which one is not seen"
        kind = kind if tests.bands[best, i] >= FEWEST_BANDS else "sensor or structure"
        size, u = float(tests.joint.size[best, i, direction]), float(tests.joint.u[best, i, direction])
        u = float(np.hypot(u, U_TURN * size)) if direction > ALL else u
        return SensorVerdict(kind, what, size, COVERAGE * u, *dates, z, direction)
    return noise


def _clocks(watch: SiteWatch, sensors: list[SensorVerdict]) -> None:
    """A sensor of which nothing else is told, and whose hours were not those of the others on the last day."""
    for i in np.flatnonzero(watch.lag_h).tolist():
        if sensors[i].kind in ("none", "learning"):
            hours, late = abs(int(watch.lag_h[i])), "late" if watch.lag_h[i] > 0.0 else "early"
            sensors[i] = SensorVerdict("clock", f"its hours come {hours} h {late} against those of the other sensors")


def _excited(watch: SiteWatch, tests: Tests, i: int, told: SensorVerdict, limit: float) -> SensorVerdict:
    """What sensor `i` is told of; or that it is excited otherwise, where quiet and loud hours differ by another amount
    since then, on any axis. A sensitivity changes all hours alike, and damage nearly so. Bands that change differently
    are told as that: outputs that are exchanged change their hours as well."""
    if told.kind not in ("sensitivity", "one of two"):
        return told
    begins = watch.contrasts.begins
    which = [k for k in _begins(watch) if begins[k] >= told.earliest - FEWEST_SINCE]
    step, u = (part[:, i] for part in _followed(watch, watch.contrasts, watch.contrast_scatter, which))
    at = tests.begins.index(told.since)
    rest, info = tests.joint.rest[at, i, :, :3], tests.joint.information[at, i, :, :3]
    size = np.sqrt(np.sum(info * np.square(rest), axis=0) / np.maximum(info.sum(axis=0), 1e-300))
    z = np.where(np.abs(step) > PART_CONTRASTED * size, np.abs(step) / u, 0.0).max(axis=1)
    if z.max() <= limit:
        return told
    best, dates = dated([begins[k] for k in which], np.square(z))
    what = "its quiet and loud hours differ otherwise: what moves the structure there has changed"
    return SensorVerdict("excitation", what, 0.0, np.inf, *dates, float(z[best]))


def _of_two(tests: Tests, sensors: list[SensorVerdict]) -> None:
    """Where two sensors are compared, a turn of one moves the amplitudes of both: what the other one shows follows."""
    turned = max((told.statistic for told in sensors if told.kind == "turn"), default=0.0)
    if tests.joint.pair[-1]:
        sensors[:] = [NOTHING if told.kind in FOLLOW and told.statistic < turned else told for told in sensors]


def witnessed(watch: SiteWatch, i: int, told: SensorVerdict) -> SensorVerdict:
    """The verdict of sensor `i` with what each witness says of it at its date."""
    if told.kind not in SUSPECTED:
        return told
    k, u = watch.means.begins.index(told.since), told.U / COVERAGE
    step, u_step = (part[0, i] for part in _followed(watch, watch.means, watch.mean_scatter, [k]))
    floor, u_floor = (part[0, i] for part in _followed(watch, watch.noise, watch.noise_scatter, [k]))
    mean = watch.means.beta[0].reshape(-1, 3)[i]
    others: tuple[Witness, ...]
    others = gravity(told.direction, told.size, u, mean, step, u_step), noise(told.direction, floor, u_floor)
    if watch.self_tests.days.reshape(-1, 3)[i].any():
        shown, u_shown = (part[0, i] for part in _followed(watch, watch.self_tests, watch.self_test_scatter, [k]))
        others = *others, self_test(told.direction, told.size, u, shown, u_shown, watch.u_supply[i])
    return replace(told, witnesses=(Witness("structure", "agrees", told.size, u), *others))


def _followed(watch: SiteWatch, steps: Steps, scatter: Blocks, which: list[int]) -> tuple[Array, Array]:
    """Steps of noise floors or means at these begins, (k, n, 3), and their u; inf where too few days tell of one."""
    shape = watch.shape[0], 3
    size, information, since = (part.reshape(-1, *shape) for part in steps.step(which))
    days = steps.days.reshape(shape)
    counts = (since >= FEWEST_SINCE) & (days - since >= FEWEST_DAYS) & (information > 0.0)
    without = _without(pooled(*steps.rest(), shape), size, information, days)
    grown = scatter.over(watch.day, [steps.begins[k] for k in which])
    return size, np.where(counts, np.sqrt(without * grown / np.where(counts, information, 1.0)), np.inf)


def _noise(watch: SiteWatch, limit: float) -> list[SensorVerdict]:
    """Has the noise floor of an output changed? For each sensor."""
    steps, shape = watch.noise, (watch.shape[0], 3)
    which = [k for k, begin in enumerate(steps.begins) if watch.day - begin + 1 >= FEWEST_SINCE]
    size, u = _followed(watch, steps, watch.noise_scatter, which)
    days, z = steps.days.reshape(shape), np.abs(size) / u
    told = []
    for i in range(shape[0]):
        k, axis = np.unravel_index(int(np.argmax(z[:, i])), (len(which), 3))
        begin, factor = steps.begins[which[k]], float(np.exp(size[k, i, axis]))
        expanded = COVERAGE * float(u[k, i, axis]) * factor
        found = SensorVerdict("noise", f"noise of {'xyz'[axis]}", factor - 1.0, expanded,
                              begin, begin, begin, float(z[k, i, axis]))  # fmt: skip
        few = student_quantile(NORMAL.cdf(limit), float(days[i, axis]) - TERMS + PRIOR_DEGREES)
        told.append(found if found.statistic > few and abs(found.size) > LEAST_NOISE else NOTHING)
    return told


def _gateways(watch: SiteWatch, tests: Tests, sensors: list[SensorVerdict], limit: float) -> dict[int, SensorVerdict]:
    """All sensors of a gateway alike, against the median of all gateways. A sensor that its gateway explains is not
    told, and one whose bands change differently says nothing of its gateway."""
    numbers, index = np.unique(watch.gateway, return_inverse=True)
    told: dict[int, SensorVerdict] = {}
    if len(numbers) < 2:
        return told
    alike = np.array([told.kind not in ("sensor or structure", "excitation") for told in sensors])
    mean, u, fits = _means(tests.joint, index, alike)
    pair = len(numbers) == 2
    what = "the two gateways differ; which of them changed is not seen" if pair else "all its sensors alike"
    for g, number in enumerate(numbers.tolist()[: 1 if pair else None]):
        own = index == g
        best, dates = tests.dated(np.square(mean[:, g] / u[:, g] * tests.joint.scatter[:, 0, ALL]))
        z = abs(float(mean[best, g] / u[best, g]))
        alone = np.abs(tests.joint.statistic[best, own, SENSITIVITIES]).max()
        if z > max(limit, alone) and fits[best, g] and (own & alike).sum() > 1:
            told[number] = SensorVerdict("gateway", what, float(mean[best, g]), COVERAGE * float(u[best, g]), *dates, z)
    for i, verdict in enumerate(sensors):
        if verdict.kind == "sensitivity" and told and (pair or int(watch.gateway[i]) in told):
            sensors[i] = NOTHING
    return told


def _means(joint: JointChange, index: NDArray[np.int64], counts: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Mean change of those sensors of each gateway that count, against the median of the gateways (k, g), its u,
    and whether its sensors agree. Of two gateways: their difference."""
    s, weight = joint.size[:, :, ALL], counts / np.square(joint.u[:, :, ALL])
    member = np.eye(index.max() + 1)[index]  # (n, g)
    total = weight @ member
    mean = np.where(total > 0.0, (weight * s) @ member / np.where(total > 0.0, total, 1.0), np.nan)
    shared = 1.0 + PART_SHARED * np.maximum((weight > 0.0) @ member - 1.0, 0.0)
    variance = np.where(total > 0.0, shared / np.where(total > 0.0, total, 1.0), np.inf)
    pair = mean.shape[1] == 2
    centre = mean[:, 1] if pair else median(mean, axis=1)
    others = variance[:, 1] if pair else np.pi / 2.0 / np.maximum((total / shared).sum(axis=1), 1e-300)
    away = np.abs(s - np.nan_to_num(mean) @ member.T)
    reach = np.maximum(4.0 * joint.u[:, :, ALL], 0.3 * np.abs(np.nan_to_num(mean - centre[:, None]) @ member.T))
    wrong = ((away > reach) & (weight > 0.0)) @ member
    return np.nan_to_num(mean - centre[:, None]), np.sqrt(variance + others[:, None]), wrong == 0.0


def _structure(tests: Tests, sensors: list[SensorVerdict]) -> SensorVerdict:
    """Damage: bands change differently at several sensors, or at most of them."""
    own = [i for i, told in enumerate(sensors) if told.kind == "sensor or structure"]
    apart = np.maximum(tests.apart[:, own].max(axis=1, initial=0.0), 0.0)
    best, dates = tests.dated(apart**2)
    z = float(apart[best])
    if len(own) >= 2 and not tests.joint.pair[best]:
        for i, told in enumerate(sensors):  # what is weaker than the damage may follow from it
            if told.kind in ("sensitivity", "turn") and told.statistic < z:
                sensors[i] = NOTHING
        for i in own:
            what = "its bands change differently, as those of other sensors do"
            sensors[i] = SensorVerdict("structure", what, 0.0, np.inf, *dates, sensors[i].statistic)
        return SensorVerdict("structure", f"bands change differently at {len(own)} sensors", 0.0, np.inf, *dates, z)
    return NOTHING


def _common_change(tests: Tests, known_u: Array, anchored: Array) -> SensorVerdict:
    """What the sensors without a reference share, seen from those that have one: these change by known_u at most."""
    s, u = tests.joint.size[:, anchored, ALL], tests.joint.u[:, anchored, ALL]
    weight = 1.0 / (np.square(u) + 2.0 * np.square(known_u))
    total = weight.sum(axis=1)
    some = total > 0.0
    total = np.where(some, total, 1.0)
    mean, u_mean = -np.sum(weight * s, axis=1) / total, np.where(some, 1.0 / np.sqrt(total), np.inf)
    best, dates = tests.dated(np.square(mean / u_mean))
    z = abs(float(mean[best] / u_mean[best]))
    return SensorVerdict(
        "common", "all sensors without a reference", float(mean[best]), COVERAGE * float(u_mean[best]), *dates, z
    )


def _common_by_visits(watch: SiteWatch) -> SensorVerdict | None:
    """What all sensors share, from visits: what each found, without what the watch told of this sensor alone.

    Visits may rest on one reference, so their mean has at least the uncertainty of the best of them.
    """
    recent = watch.visits[watch.visits[:, VISIT.index("day")] > watch.day - VISITS_DAYS]
    if not len(recent):
        return None
    _, _, _, size, u, found, u_found = recent.T
    weight = 1.0 / (u**2 + u_found**2)
    mean = float(np.sum(weight * (found - size)) / weight.sum())
    u_mean = max(float(weight.sum()) ** -0.5, float(u_found.min()))
    what = f"all sensors, by {len(recent)} visits in {VISITS_DAYS} days"
    return SensorVerdict("common", what, mean, COVERAGE * u_mean, statistic=abs(mean) / u_mean)
