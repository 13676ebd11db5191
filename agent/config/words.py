"""What a model says of a wrong value, in our words; and which setting was meant by a name that is none."""

from __future__ import annotations

import difflib
import functools
import re
import unicodedata
from collections.abc import Iterator, Mapping
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel

from agent.config.lines import Path

NUMBER = "a number is needed, without quotes and unit"
LIST = 'a list in brackets is needed, as [1, 2] or ["x", "y"]'
_IN_WORDS = {
    "missing": "is missing; add it",
    "tuple_type": LIST,
    "list_type": LIST,
    "float_type": NUMBER,
    "float_parsing": NUMBER,
    "finite_number": "a finite number is needed",
    "int_type": f"{NUMBER}, a whole one",
    "int_parsing": f"{NUMBER}, a whole one",
    "int_from_float": "a whole number is needed",
    "bool_type": "true or false is needed, without quotes",
    "bool_parsing": "true or false is needed, without quotes",
    "string_type": "a text in quotes is needed",
    "path_type": "a path in quotes is needed",
    "string_pattern_mismatch": "does not have the form that the reference of the configuration states",
    "byte_size": 'a number of bytes is needed, or a text as "256 MiB"',
    "byte_size_unit": 'a number of bytes is needed, or a text as "256 MiB"',
    "greater_than": "must be above {gt:g}",
    "greater_than_equal": "must be {ge:g} or more",
    "less_than": "must be below {lt:g}",
    "less_than_equal": "must be {le:g} or less",
    "too_short": "has {actual_length} entries, at least {min_length} are needed",
    "too_long": "has too many entries, at most {max_length} are allowed",
    "string_too_short": "must have at least {min_length} characters",
    "string_too_long": "must have at most {max_length} characters",
}
_TABLES = ("dict_type", "model_type", "model_attributes_type")
_A_NUMBER = re.compile(r"\s*([-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?)")
_A_UNIT = "m/s2"  # which every list of units has
ELSEWHERE = 0.8  # how like a name of another section must be
_SOME = 3  # places at most that are named for a setting


def in_words(fault: Mapping[str, Any], path: Path) -> str:
    """What is wrong by a fault of pydantic at this path, and what to do."""
    name, context, value = fault["type"], fault.get("ctx") or {}, fault.get("input")
    header = ".".join(str(part) for part in path if isinstance(part, str))
    if name == "literal_error":
        return _one_of(str(context["expected"]), value)
    if name in _TABLES:
        return f"a table is needed, as [{header}] with a setting in each line"
    if name in ("tuple_type", "list_type") and isinstance(value, Mapping):
        return f"there may be several, so that each begins with two brackets: [[{header}]]"
    words = _IN_WORDS.get(name)
    if words is None:
        return str(fault["msg"]).removeprefix("Value error, ").replace("Input should be", "must be")
    if words.startswith(NUMBER) and isinstance(value, str) and (found := _A_NUMBER.match(value)):
        words += f": {found[1].replace(',', '.')}"
    return words.format(**context)


def length_fault(stated: list[Any] | tuple[Any, ...], path: Path, kind: type[BaseModel]) -> str:
    """What is wrong with the number of entries of a list that has a fixed one; "" where nothing is."""
    needed = {
        len(get_args(one))
        for annotation in _annotations(kind, path)
        for one in _parts(annotation)
        if get_origin(one) is tuple and Ellipsis not in get_args(one)
    }
    if not needed or len(stated) in needed:
        return ""
    what = "numbers" if all(isinstance(one, int | float) for one in stated) else "entries"
    in_rows = ", row by row in one list" if any(isinstance(one, list) for one in stated) else ""
    return f"has {len(stated)} {what}, needs {' or '.join(map(str, sorted(needed)))}{in_rows}"


def may_be_truth(kind: type[BaseModel], path: Path) -> bool:
    """Whether a setting may be true or false; also where nothing is known of it."""
    types = [one for annotation in _annotations(kind, path) for one in _parts(annotation)]
    return not types or any(one in (bool, Any) for one in types)


def remedy(kind: type[BaseModel], path: Path) -> str:
    """What to do about a setting at `path` that a file of this kind does not have."""
    name, here = str(path[-1]), {field for model in _models(kind, path[:-1]) for field in model.model_fields}
    wanted = name.lower().replace("-", "_").replace(" ", "_")
    places = [".".join((*place, wanted)) for place, model in _sections(kind) if wanted in model.model_fields]
    if wanted in here:
        return f"write {wanted}"
    if places:
        return f"it belongs into another section: {' or '.join(places[:_SOME])}"
    if near := difflib.get_close_matches(wanted, here, n=1):
        return f"did you mean {near[0]}?"
    if "options" in here:
        return "an option of the driver belongs into the section options of its device"
    everywhere = {field: (*place, field) for place, model in _sections(kind) for field in model.model_fields}
    if near := difflib.get_close_matches(wanted, everywhere, n=1, cutoff=ELSEWHERE):
        return f"did you mean {'.'.join(everywhere[near[0]])}?"
    return f"remove it or correct its name; there are {', '.join(sorted(here))}"


def _one_of(expected: str, value: Any) -> str:
    """Which texts or numbers a setting may be, and which of them was meant."""
    words = f"must be {expected}"
    if not isinstance(value, str):
        return words
    allowed = re.findall(r"'([^']*)'", expected)
    wanted = unicodedata.normalize("NFKC", value).strip().lower()  # m/s² is m/s2
    if _A_UNIT in allowed:
        return f"{words}{_unit_meant(value, wanted, allowed)}"
    near = difflib.get_close_matches(wanted, [one.lower() for one in allowed], n=1)
    found = [one for one in allowed if near and one.lower() == near[0]]
    return f"{words}; write {found[0]!r}" if found else words


def _unit_meant(value: str, wanted: str, allowed: list[str]) -> str:
    """The unit that was written in another way; a unit that only looks like it, as mg like g, is another one."""
    spelt = re.sub(r"[\s^*]", "", wanted)
    if found := [one for one in allowed if one.lower() in (spelt, spelt.removesuffix("s"))]:
        return f"; write {found[0]!r}"
    other = ", not {value!r}; of another unit write 'count', and state the sensitivity in that unit per m/s2"
    return other.format(value=value) if "count" in allowed else ""


def _annotations(kind: type[BaseModel], path: Path) -> list[Any]:
    """The types that the setting at a path may have."""
    return [m.model_fields[str(path[-1])].annotation for m in _models(kind, path[:-1]) if path[-1] in m.model_fields]


def _models(kind: type[BaseModel], path: Path) -> list[type[BaseModel]]:
    """The sections that a path may be."""
    models = [kind]
    for part in (part for part in path if isinstance(part, str)):
        found = [model.model_fields[part].annotation for model in models if part in model.model_fields]
        models = [one for annotation in found for one in _parts(annotation) if _is_section(one)]
    return models


@functools.cache
def _sections(kind: type[BaseModel]) -> list[tuple[tuple[str, ...], type[BaseModel]]]:
    """All sections within this one and their places, this one first."""
    found: list[tuple[tuple[str, ...], type[BaseModel]]] = [((), kind)]
    for name, field in kind.model_fields.items():
        for one in filter(_is_section, _parts(field.annotation)):
            found += [((name, *place), model) for place, model in _sections(one)]
    return found


def _parts(annotation: Any) -> Iterator[Any]:
    """A type and all types in it."""
    yield annotation
    for one in () if get_origin(annotation) is Literal else get_args(annotation):
        yield from _parts(one)


def _is_section(one: Any) -> bool:
    return isinstance(one, type) and issubclass(one, BaseModel)
