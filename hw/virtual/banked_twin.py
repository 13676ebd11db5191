"""Common part of the twins whose registers lie in banks: a register's number has its bank in the upper byte."""

from __future__ import annotations

from typing import ClassVar

from hw.virtual.fifo_twin import FifoTwin


class BankedTwin(FifoTwin):
    """See FifoTwin. The register `bank_select` is the same one in all banks."""

    bank_select: ClassVar[int]
    bank_unit: ClassVar[int]

    def _selected(self, address: int) -> int:
        if address == self.bank_select:
            return address
        return self.registers[self.bank_select] // self.bank_unit << 8 | address
