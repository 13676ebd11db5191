"""What signed results cost: CPU time for each result at the gateway and at a consumer.

python -m benchmarks.signing
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from agent.config.known_keys import WatchedKeys
from agent.delivery.received import receive
from agent.delivery.verifying import Verifier
from tests.attacks.chain_site import KEY
from tests.attacks.signed_site import PLACE, listed, signed_record, signer_of
from tests.unit.results import calibration

COUNT = 2000
EPOCH = "00c0ffee00c0ffee"


def each_us(what: Callable[[int], object]) -> float:
    """CPU time of one call, in microseconds."""
    began_s = time.process_time()
    for number in range(1, COUNT + 1):
        what(number)
    return (time.process_time() - began_s) / COUNT * 1e6


def main() -> None:
    """Measure, and print the table."""
    results = [calibration(number) for number in range(COUNT + 1)]
    plain, signer = signer_of("site/gw", EPOCH, None), signer_of("site/gw", EPOCH, KEY)
    encoded_us = each_us(lambda n: plain.encode(n, results[n]))
    signed_us = each_us(lambda n: signer.encode(n, results[n]))
    record = signed_record(results[7], signer, EPOCH)
    with tempfile.TemporaryDirectory() as directory:
        verifier = Verifier(WatchedKeys(listed(Path(directory) / "known.keys", KEY)))
        plain_us = each_us(lambda _: receive(PLACE, record.payload, b"6"))
        verified_us = each_us(lambda _: receive(PLACE, record.payload, b"6\n" + record.signed, verifier))
    print("| of a calibration, the largest result | without a key | signed | more |\n| --- | --- | --- | --- |")
    for name, without, with_key in (
        ("gateway: encoded for the recording", encoded_us, signed_us),
        ("consumer: received", plain_us, verified_us),
    ):
        print(f"| {name} | {without:.0f} us | {with_key:.0f} us | {with_key - without:.0f} us |")
    print(f"\nThe signed bytes have {len(record.signed)} bytes, the JSON has {len(record.payload)}.")


if __name__ == "__main__":
    main()
