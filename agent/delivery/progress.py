"""How far a consumer has come with each gateway, by epoch: the numbering that a store gives its results.

A store that was lost counts anew, perhaps from a lower number. Its results have another epoch, and so another counter.
"""

from __future__ import annotations

from collections.abc import Mapping

from agent.delivery.received import Received

EPOCHS_MAX = 20  # newest epochs kept of one gateway; a gateway that loses its store more often has other troubles


class Progress:
    """The last result of each gateway and epoch.

    `numbers`: by `<site>/<gateway>/<epoch>`, of one gateway the newest epoch last. A number without an epoch is by
    `<site>/<gateway>`: of results of an older version, or given by a user.
    """

    def __init__(self, numbers: Mapping[str, int]) -> None:
        self.numbers = dict(numbers)
        self._current: dict[str, str] = {}
        for name in self.numbers:
            self._current["/".join(name.split("/")[:2])] = name

    def number(self, source: str) -> int | None:
        """The last result of a gateway, in its newest epoch; None where nothing is known of it."""
        return self.numbers[self._current[source]] if source in self._current else None

    def has(self, result: Received) -> bool:
        """Whether this result, or a later one of its epoch, was taken before."""
        return result.sequence <= self.numbers.get(_name(result), -1)

    def is_other_epoch(self, result: Received) -> bool:
        """Whether the gateway is known, and this epoch of it is not."""
        return result.address.source in self._current and _name(result) not in self.numbers

    def is_next(self, result: Received) -> bool:
        """Whether this is the very next result of its gateway and epoch, so that none can be missing before it."""
        known = self.numbers.get(_name(result))
        return known is not None and result.previous == known and result.sequence == known + 1

    def without_epoch(self, source: str) -> bool:
        """Whether the newest number of a gateway was given without its epoch."""
        return self._current.get(source) == source

    def adopt(self, source: str, epoch: str, number: int) -> None:
        """A number that was given without its epoch belongs to this one."""
        self._set(source, f"{source}/{epoch}" if epoch else source, number)

    def take(self, result: Received) -> None:
        """The result is the newest of its gateway."""
        self._set(result.address.source, _name(result), result.sequence)

    def _set(self, source: str, name: str, number: int) -> None:
        if self._current.get(source) == name:
            self.numbers[name] = number
            return
        self.numbers.pop(name, None)  # so that the newest epoch is the last one
        self._current[source] = name
        self.numbers[name] = number
        epochs = [other for other in self.numbers if other == source or other.startswith(f"{source}/")]
        for oldest in epochs[:-EPOCHS_MAX]:
            del self.numbers[oldest]


def _name(result: Received) -> str:
    source = result.address.source
    return f"{source}/{result.epoch}" if result.epoch else source
