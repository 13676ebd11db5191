"""One mutation of each kind of benchmarks/mutations.py: none passes with the key and a head."""

from __future__ import annotations

from benchmarks.mutations import MUTATIONS, run


def test_no_mutation_passes_with_key_and_head_and_some_do_without() -> None:
    tried, with_key, without = run(len(MUTATIONS), 60.0)
    assert all(tried[kind] == 1 for kind in MUTATIONS)
    assert with_key.total() == 0
    # Nothing but a key or a head shows these.
    assert all(without[kind] for kind in ("last files dropped", "directory of another epoch", "key revoked"))
