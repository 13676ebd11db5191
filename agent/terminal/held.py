"""Which of the windows that are not used are held."""

from __future__ import annotations

from agent.core.events import WindowReport

CONTRADICTION = "innovation_chi2"  # in the numbers of each window that was compared with the state


def is_held(window: WindowReport) -> bool:
    """Whether a window is held: it was compared with the state, and further windows may confirm it."""
    return not window.used and CONTRADICTION in window.numbers
