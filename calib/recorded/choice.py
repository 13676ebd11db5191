"""Chooses columns of a table: those that are stated, those with this program's names, or those that it can guess."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass
from string import ascii_lowercase
from typing import Any, Protocol, TypeVar

from calib.recorded.errors import InputError
from calib.recorded.units import G_FORCE, UNITS, split, unit_of

TIME_WORDS = frozenset(
    ["time", "timestamp", "t", "datetime", "date", "epoch", "stamp", "utc", "zeit", "temps", "seconds", "secs"]
)
TEMPERATURE_WORDS = frozenset(["temperature", "temp", "degc"])
# Quantities of a reference with one axis, by the words of a column's name; "a" and "d" are also this program's names.
QUANTITY_WORDS = {
    "acceleration": frozenset(["a", "acc", "accel", "acceleration", "beschleunigung", "accelerazione"]),
    "velocity": frozenset(["v", "vel", "velocity", "speed"]),
    "displacement": frozenset(["d", "disp", "displacement", "position"]),
}
_DEGREES = re.compile(r"(?:°|deg(?:rees?)?)[ _]?[cfk]?|celsius|fahrenheit|kelvin|[cfk]", re.IGNORECASE)
_IN_BRACKETS = re.compile(r"[\[(]([^\])]*)[\])]\s*$")
_OTHER_AXES = re.compile(r"(gyr|mag|ang|rot|quat|eul|vel|pos|disp|orient|cov|omega|grav)")
_AXIS = re.compile(r"(?:a|v|s|acc|accel|acceleration|accelerometer)?([xyz])")
AXES = ("x", "y", "z")
# Columns of a seismometer: E, N, Z, or with the codes of band and instrument before (SEED), as HNE.
_COMPASS = {
    "x": re.compile(r"e|ew|we|east|[a-z][hlng]e"), "y": re.compile(r"n|ns|sn|north|[a-z][hlng]n"),
    "z": re.compile(r"z|u|ud|up|vert|vertical|[a-z][hlng]z"),
}  # fmt: skip
# Two columns of one time, as ROS and C write it: whole seconds, and their parts.
_WHOLE_SECONDS = frozenset(["sec", "secs", "second", "seconds"])
_PARTS_OF_SECONDS = {
    word: scale
    for scale, told in ((1e-3, "m milli"), (1e-6, "u micro"), (1e-9, "n nano"))
    for prefix in told.split() for word in (f"{prefix}{unit}" for unit in _WHOLE_SECONDS)
}  # fmt: skip
_ENDS = ("ew", "we", "ns", "sn", "ud")  # of a line, where they are two words: N-S
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Column:
    """A column of numbers as the table names it.

    `unit`: as the table states it, "" where it states none. A time that is given as a date has the unit "s": it is
    in seconds since 1970, UTC. `group`: the device, channel group or topic to which the column belongs; "" where the
    table has no groups.
    """

    name: str
    unit: str = ""
    group: str = ""

    def __str__(self) -> str:
        return f"{self.group}.{self.name}" if self.group else self.name


class NamedColumns(Protocol):
    """What has named columns: a file, or a table in memory. `header`: where it names them, for messages. `repeated`:
    columns of times that another column tells too. `remedy`: what to do where other columns are needed, "" for what is
    always said."""

    path: Any
    columns: Sequence[Column]
    header: str
    repeated: Sequence[Column]
    remedy: str


@dataclass(frozen=True, slots=True)
class ChosenColumn:
    """A column and its unit in lower case, "" where none is stated."""

    column: Column
    unit: str


class Choice:
    """Chooses columns of a table. `stated`: the text of the option `option`, such as "time=t,x=ax". Raises InputError.

    A table in memory has no such option, "": its columns can be renamed.

    Words on the left side are time, x, y, z, temperature, a, v, d and group; on the right side stands a name of a
    column, with ":UNIT" if the file does not state the unit.
    """

    def __init__(self, source: NamedColumns, stated: str | None = None, option: str = "") -> None:
        self._source, self._option = source, option
        self._stated = self._read(stated)
        group = self._stated.pop("group", None)
        self.said: list[str] = []  # what was guessed
        self._columns = [c for c in source.columns if group is None or c.group == group]
        if not self._columns:
            raise self.fault(f"there is no group {group!r}" if group else "there are no columns of numbers")

    def in_one_group(self, choose: Callable[[Choice], Result]) -> Result:
        """What `choose` finds in the only group where it finds something. Raises InputError if there is no such one.

        Where several groups have something, the one with the fewest columns is taken if it is the only one: a device
        with one axis is the reference.
        """
        groups = list(dict.fromkeys(c.group for c in self._columns))
        if self.is_stated or len(groups) < 2:
            return choose(self)
        found: dict[str, tuple[Choice, Result]] = {}
        for group in groups:
            inner = copy(self)
            inner._columns, inner.said = [c for c in self._columns if c.group == group], []
            with suppress(InputError):
                found[group] = (inner, choose(inner))
        sizes = {group: len(inner._columns) for group, (inner, _) in found.items()}
        fewest = [group for group, size in sizes.items() if size == min(sizes.values())]
        if len(fewest) != 1:
            told = f"several groups could be meant ({', '.join(fewest)})" if found else "no group has what is needed"
            raise self.fault(f"{told}, add group=NAME: it is")
        inner, result = found[fewest[0]]
        other = f"state another with {self._option} group=NAME"
        self.said += inner.said or [f"{self._source.path}: group {fewest[0]} is taken; {other}"]
        return result

    def _read(self, stated: str | None) -> dict[str, str]:
        words: dict[str, str] = {}
        for part in re.split(r",(?=\s*\w+\s*=)", stated) if stated else ():
            word, equals, name = (piece.strip() for piece in part.partition("="))
            if not equals or not name or word not in ("time", *AXES, "temperature", "a", "v", "d", "group"):
                raise InputError(
                    f"{self._option}: {part!r} is not understood; write time=NAME,x=NAME,y=NAME,z=NAME with names of "
                    "columns; a unit may follow a name: x=NAME:mg"
                )
            words[word] = name
        return words

    def fault(self, what: str) -> InputError:
        """An error that says what was seen and how to say it."""
        seen = ",".join(str(c) for c in self._source.columns[:24])
        more = ",..." if len(self._source.columns) > 24 else ""
        remedy = self._source.remedy or (
            f"say which columns to use: {self._option} time=NAME,x=NAME,... (a unit may follow a name: x=NAME:mg)"
            if self._option else "rename the columns; a unit may stand in a name: 'x [mg]'"
        )  # fmt: skip
        return InputError(f"{what} in the header {seen + more!r}", remedy, place=self.place)

    def unknown(self, unit: str, column: str) -> InputError:
        """An error that says which units are known."""
        return self.fault(f"unit {unit!r} of column {column!r} is not known; known are {', '.join(UNITS)}")

    @property
    def place(self) -> str:
        """Where the columns are named, for messages."""
        return f"{self._source.path}, {self._source.header}" if self._source.header else str(self._source.path)

    @property
    def can_be_stated(self) -> bool:
        """Whether an option can state the columns."""
        return bool(self._option)

    @property
    def is_stated(self) -> bool:
        """Whether columns are stated."""
        return bool(self._stated)

    def stated(self, word: str) -> ChosenColumn | None:
        """The column that is stated for `word`, None where none is."""
        name = self._stated.get(word)
        if name is None:
            return None
        for candidate, unit in ((name, ""), (name.rpartition(":")[0], name.rpartition(":")[2])):
            found = [c for c in self._columns if candidate in (c.name, str(c))]
            if len(found) > 1:
                groups = ", ".join(repr(c.group) for c in found)
                raise self.fault(f"column {candidate!r} is in several groups ({groups}), add group=NAME")
            if found and unit and unit_of(unit) is None:
                raise self.unknown(unit, candidate)
            if found and word == "time":
                self._check_whole(found[0])
            if found:
                return ChosenColumn(found[0], unit or _unit(found[0]))
        raise self.fault(f"there is no column {name!r}")

    def standard(self, names: Iterable[str]) -> list[ChosenColumn] | None:
        """The columns that have exactly these names, in the units of these names. None where one is missing.

        Raises InputError where one of them is also there in another unit.
        """
        found = []
        for name in names:
            same = [c for c in self._columns if c.name == name]
            if len(same) != 1:
                return None
            base = name.rsplit("_", 1)[0]
            others = [c.name for c in self._columns if c.name != name and split(c.name)[1] and split(c.name)[0] == base]
            if others:
                raise self.fault(f"there are both {name} and {others[0]}")
            if same[0].unit and name == "time_s" and unit_of(same[0].unit) != unit_of("s"):
                raise self.fault(f"column {name} is in {same[0].unit!r}")
            found.append(ChosenColumn(same[0], "s" if name == "time_s" else _unit(same[0])))
        return found

    def guessed(self, role: str) -> ChosenColumn | None:
        """The only column whose name tells that it is `role`: time, x, y, z, temperature. None where none does.

        East, north and up are x, y and z where all three are there.
        """
        found = [self._compass[role]] if role in self._compass else [c for c in self._columns if _role(c) == role]
        if role == "time" and len(found) > 1:
            found = [c for c in found if c not in self._source.repeated]
        if len(found) > 1:
            raise self.fault(f"several columns could be {role}: {', '.join(repr(str(c)) for c in found)}")
        if found and role == "time":
            self._check_whole(found[0])
        return ChosenColumn(found[0], _unit(found[0])) if found else None

    def _check_whole(self, time: Column) -> None:
        """Raise InputError where another column has the parts of this one's seconds."""
        parts = [c for c in self._columns if c.group == time.group and part_of_seconds(time.name, c.name)]
        if parts:
            what = f"{str(time)!r} has whole seconds, and {str(parts[0])!r} their parts"
            raise InputError(what, "write the sum of both in one column, in s", place=self.place)

    @property
    def _compass(self) -> dict[str, Column]:
        """The columns of east, north and up as x, y and z; empty where one of them is missing or not the only one, and
        where others are called x and y."""
        if any(_role(c) in ("x", "y") for c in self._columns):
            return {}
        found = {axis: [c for c in self._columns if way.fullmatch(_way(c))] for axis, way in _COMPASS.items()}
        return {axis: of[0] for axis, of in found.items()} if all(len(of) == 1 for of in found.values()) else {}

    def rest(self, taken: Sequence[ChosenColumn]) -> list[ChosenColumn]:
        """The columns that are not taken and that are neither times nor temperatures."""
        columns = [t.column for t in taken]
        group = {c.group for c in columns}
        return [
            ChosenColumn(c, _unit(c)) for c in self._columns
            if c not in columns and _role(c) not in ("time", "temperature") and (not group or c.group in group)
        ]  # fmt: skip

    def unnamed_time(self) -> ChosenColumn | None:
        """The first column where no column has a name, and one or three stand behind it. None where that is not so."""
        unnamed = not self.is_stated and all(c.name.isdigit() for c in self._columns)
        return (
            ChosenColumn(self._columns[0], _unit(self._columns[0]))
            if unnamed and len(self._columns) in (2, 4)
            else None
        )

    def in_their_order(self, three: Sequence[ChosenColumn]) -> Sequence[ChosenColumn]:
        """The three columns as x, y and z. Raises InputError where their names tell another order."""
        told = [_way(c.column) for c in three]
        if _in_another_order(told) or any(map(_COMPASS["z"].fullmatch, told[:2])):
            names = ", ".join(repr(str(c.column)) for c in three)
            raise self.fault(f"the names {names} tell another order than x, y, z")
        return three

    def say(self, found: Mapping[str, ChosenColumn]) -> None:
        """Keep for the user what was guessed."""
        told = ", ".join(f"{word}={c.column}{f' in {c.unit}' if c.unit else ''}" for word, c in found.items())
        other = f"state others with {self._option}" if self._option else "rename them where others are meant"
        self.tell(f"columns guessed: {told}; {other}")

    def tell(self, what: str) -> None:
        """Keep for the user what was found or decided."""
        self.said.append(f"{self._source.path}: {what}")


def quantity_of(chosen: ChosenColumn) -> str | None:
    """The quantity of a column by its unit, or by its name. None where neither tells."""
    unit = unit_of(chosen.unit) if chosen.unit else None
    if unit is not None and unit.quantity in QUANTITY_WORDS:
        return unit.quantity
    told = set(words(split(chosen.column.name)[0]))
    return next((quantity for quantity, known in QUANTITY_WORDS.items() if told & known), None)


def _unit(column: Column) -> str:
    return column.unit or split(column.name)[1]


def _in_another_order(told: Sequence[str]) -> bool:
    """Whether three numbers, or three letters that follow each other in the alphabet, do not increase."""
    if all(word.isdigit() for word in told):
        return [int(word) for word in told] != sorted(map(int, told))
    return "".join(sorted(told)) in ascii_lowercase and list(told) != sorted(told)


def _way(column: Column) -> str:
    """The word of a column's name that tells its direction or its number: the last one."""
    told = words(split(column.name)[0]) or [""]
    return ends if (ends := "".join(told[-2:])) in _ENDS else told[-1]


def words(name: str) -> list[str]:
    """The words and numbers of a column's name, in lower case."""
    return re.findall(r"[a-z]+|\d+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())


def names_time(name: str, unit: str = "") -> bool:
    """Whether the name of a column tells a time. T in degrees, in brackets or in the row of units, is a temperature."""
    found = _IN_BRACKETS.search(name)
    in_degrees = _DEGREES.fullmatch((unit or (found[1] if found else "")).strip("[]() "))
    return bool(TIME_WORDS & set(words(split(name)[0]))) and not in_degrees


def part_of_seconds(whole: str, part: str) -> float:
    """How many s are one unit of the column `part`, where by their names it has the parts of the seconds in the column
    `whole`; otherwise 0."""
    first, second = words(whole), words(part)
    alike = bool(first) and bool(second) and first[:-1] == second[:-1] and first[-1] in _WHOLE_SECONDS
    return _PARTS_OF_SECONDS.get(second[-1], 0.0) if alike else 0.0


def _role(column: Column) -> str:
    told = words(split(column.name)[0])
    if names_time(column.name, column.unit):
        return "time"
    if TEMPERATURE_WORDS & set(told) or TIME_WORDS & set(told):
        return "temperature"
    if not told or any(_OTHER_AXES.match(word) for word in told):
        return ""
    found = G_FORCE.fullmatch(column.name) or _AXIS.fullmatch(told[-1])
    found = found or (_AXIS.fullmatch(told[0]) if told[0] in AXES else None)
    return found[1].lower() if found else ""
