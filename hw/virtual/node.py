"""A simulated device node, which can be removed and connected again."""

from __future__ import annotations

import os
import weakref


class Node:
    """`gone_errno` is what a file gets that was opened before the node was removed."""

    gone_errno: int

    def __init__(self, name: str) -> None:
        self.plugged = True
        self.generation = 0  # increases with each unplug: files opened before are invalid
        self.node = os.memfd_create(name)  # a file of its own, as each real node is: it can be locked
        weakref.finalize(self, os.close, self.node)

    def unplug(self) -> None:
        """Remove the node."""
        self.plugged = False
        self.generation += 1

    def replug(self) -> None:
        """Connect it again."""
        self.plugged = True
