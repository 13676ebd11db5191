"""Results that were not verified are counted by gateway, however many names strangers invent."""

from __future__ import annotations

from agent.delivery.verifying import GATEWAYS_MAX, Refusals


def test_each_refused_result_counts_once_and_strangers_beyond_the_limit_together() -> None:
    refused = Refusals()
    for k in range(GATEWAYS_MAX):
        refused.count(f"site/{k}", "it is not signed")
    for name in ("site/0", "site/a", "site/b"):
        refused.count(name, "it is not signed")
    assert refused.counts["site/0"] == 2
    assert refused.counts["site/1"] == 1
    assert refused.counts[""] == 2
    assert len(refused.counts) == GATEWAYS_MAX + 1
