"""Faults in what was given: samples, poses and options."""

from __future__ import annotations

from collections.abc import Callable


class InputError(ValueError):
    """Samples or poses that cannot be used. The message says where, what is wrong, and what to do.

    `place` is what was given: "sensor", "reference", "poses", or the name of a file. `row` counts from 0, as `iloc` of
    a DataFrame does; None where the fault is not in one row. `column` is "" where the fault is not in one column.
    `value` is the wrong value, None where there is none. `problem` says what is wrong, `remedy` what to do.
    """

    def __init__(
        self, problem: str, remedy: str = "", *, place: str = "", row: int | None = None, column: str = "",
        value: object = None,
    ) -> None:  # fmt: skip
        super().__init__(problem)
        self.problem, self.remedy, self.place, self.row, self.column, self.value = (
            problem, remedy, place, row, column, value
        )  # fmt: skip

    def __str__(self) -> str:
        return self.message("row {}".format)

    def message(self, row: Callable[[int], str]) -> str:
        """The message, with the number of the row in the words of `row`."""
        where = [self.place, "" if self.row is None else row(self.row), self.column and f"column {self.column}"]
        what = self.problem + (f"; {self.remedy}" if self.remedy else "")
        return f"{', '.join(filter(None, where))}: {what}" if any(where) else what


class UnitError(InputError):
    """Accelerations in another unit than m/s2, as the size of gravity tells. `unit`: the probable one, or ""."""

    def __init__(self, problem: str, unit: str, *, place: str, column: str, value: float) -> None:
        remedy = f"convert them from {unit} to m/s2" if unit else "exchange them, or convert the values to m/s2"
        super().__init__(problem, remedy, place=place, column=column, value=value)
        self.unit = unit


class OptionError(InputError):
    """An option that cannot be used, or not with the others. `problem` and `remedy` have names of options in `...`.

    `column` is the name of the option where one alone is wrong.
    """

    def message(self, row: Callable[[int], str]) -> str:  # noqa: ARG002 - no option has rows
        """The message."""
        return f"{self.column}: " * bool(self.column) + self.problem + f"; {self.remedy}" * bool(self.remedy)
