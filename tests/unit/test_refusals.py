"""Results that were not verified are counted by gateway, however many names strangers invent."""

from __future__ import annotations

from agent.delivery.verifying import GATEWAYS_MAX, REFUSED_MAX, Refusals


def test_each_refused_result_counts_once_and_strangers_beyond_the_limit_together() -> None:
    refused = Refusals()
    for k in range(GATEWAYS_MAX):
        refused.count(f"site/{k}", "it is not signed", b"{}", b"")
    for name in ("site/0", "site/a", "site/b"):
        refused.count(name, "it is not signed", b"[]", b"")
    assert refused.counts["site/0"] == 2
    assert refused.counts["site/1"] == 1
    assert refused.counts[""] == 2
    assert len(refused.counts) == GATEWAYS_MAX + 1


def test_a_refused_result_that_an_answer_repeats_does_not_count_again() -> None:
    refused = Refusals()
    for payload, signed in 3 * [(b"a", b"b"), (b"a", b""), (b"b", b"b")]:
        refused.count("site/gw", "it is not signed", payload, signed)
    assert refused.counts == {"site/gw": 3}


def test_what_is_remembered_of_refused_results_is_bounded() -> None:
    refused = Refusals()
    for k in range(2 * REFUSED_MAX):
        refused.count("site/gw", "it is not signed", b"%d" % k)
    assert refused.counts == {"site/gw": 2 * REFUSED_MAX}
    assert len(refused._refused) == REFUSED_MAX
    refused.count("site/gw", "it is not signed", b"%d" % (2 * REFUSED_MAX - 1))  # of the newest ones
    assert refused.counts == {"site/gw": 2 * REFUSED_MAX}
