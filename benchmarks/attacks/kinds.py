"""The kinds of attacks, each at ten places or in ten variants.

The forger knows all formats, and makes every CRC, index and summary right. He has no key of the gateway, but old copies
of the directory, and what the gateway signed for others.
"""

from __future__ import annotations

from dataclasses import dataclass

from agent.recording.pruned_ranges import PRUNED_METADATA
from agent.recording.results_chain import FILE_METADATA
from benchmarks.attacks.container import (
    inserted,
    one_more,
    summary_edited,
    torn,
    unknown_record,
)
from benchmarks.attacks.fields import (
    hostile_samples,
    other_engine,
    other_result,
    other_run,
    other_samples,
    other_snapshot,
    other_status,
    other_window,
)
from benchmarks.attacks.messages import (
    dropped,
    edited,
    metadata_edited,
    more_events,
    moved,
    repeated,
    signature_edited,
    times,
)
from benchmarks.attacks.site import Attack
from benchmarks.attacks.statements import head_forged, list_edited, own_statements, statements_of
from benchmarks.attacks.unsigned import forged_field, forged_results, unsigned
from benchmarks.attacks.whole_files import (
    appended,
    beside,
    doubled,
    flipped,
    from_elsewhere,
    no_file,
    put_back,
    removed,
    renamed,
    replaced,
    set_back,
    swapped,
    truncated,
)


@dataclass(frozen=True)
class Kind:
    """An attack; `keyed`: audited with the gateway's key and a kept head."""

    attack: Attack
    keyed: bool = True


NO_DIGEST = "0" * 64
KINDS: dict[str, Kind] = {
    "recordings removed": Kind(removed),
    "recording replaced by another": Kind(replaced),
    "recordings swapped": Kind(swapped),
    "recording renamed": Kind(renamed),
    "recording under a second name": Kind(doubled),
    "deleted recordings put back, changed": Kind(put_back),
    "recording truncated": Kind(truncated),
    "bytes appended or put before": Kind(appended),
    "a bit changed": Kind(flipped),
    "recordings of another epoch": Kind(from_elsewhere("epoch")),
    "recordings of another gateway": Kind(from_elsewhere("gateway")),
    "recordings of another key": Kind(from_elsewhere("key")),
    "recordings of a number used again": Kind(from_elsewhere("fork")),
    "directory set back": Kind(set_back),
    "no file in the place of a recording": Kind(no_file),
    "no recording beyond the newest": Kind(beside),
    "statements of another epoch": Kind(statements_of("epoch")),
    "statements of another gateway": Kind(statements_of("gateway")),
    "statements of another key": Kind(statements_of("key")),
    "statements of a number used again": Kind(statements_of("fork")),
    "statements of a wrong form": Kind(own_statements),
    "deleted.list changed": Kind(list_edited),
    "end removed, head forged": Kind(head_forged),
    "calibration edited": Kind(edited("Calibration", other_result)),
    "window edited": Kind(edited("Window", other_window)),
    "status edited": Kind(edited("Status", other_status)),
    "samples edited": Kind(edited("RawBlock", other_samples)),
    "samples hostile": Kind(edited("RawBlock", hostile_samples)),
    "snapshot edited": Kind(edited("Event", other_snapshot)),
    "engine named otherwise": Kind(edited("Event", other_engine)),
    "first event edited": Kind(edited("Event", other_run)),
    "events put in": Kind(more_events),
    "times of messages edited": Kind(times),
    "messages of another epoch": Kind(moved("epoch")),
    "messages of another gateway": Kind(moved("gateway")),
    "messages of a number used again": Kind(moved("fork")),
    "messages dropped": Kind(dropped),
    "messages repeated": Kind(repeated),
    "fieldcal.file edited": Kind(
        metadata_edited(
            FILE_METADATA,
            (
                {"previous_sha256": NO_DIGEST},
                {"previous_sha256": ""},
                {"epoch": NO_DIGEST[:16]},
                {"previous_results": f"0 {NO_DIGEST}"},
                {"public_key": "A" * 43 + "="},
            ),
        )
    ),
    "fieldcal.pruned edited": Kind(
        metadata_edited(
            PRUNED_METADATA,
            (
                {"recordings": f"1-4 - - {NO_DIGEST}"},
                {"recordings": "1-999999999999999999"},
                {"recordings": ""},
                {"list": f"0 {NO_DIGEST}"},
                {"recordings": "9" * 100_000, "list": "x"},
            ),
        )
    ),
    "fieldcal.repair edited": Kind(
        metadata_edited(
            "fieldcal.repair",
            ({"torn_bytes": "0"}, {"reason": "crash"}, {}, {"torn_bytes": "-1"}, {"sound_bytes": "10"}),
        )
    ),
    "signature edited": Kind(signature_edited),
    "record of an unknown kind": Kind(inserted(unknown_record)),
    "attachment put in": Kind(inserted(torn)),
    "record of the container repeated": Kind(inserted(one_more)),
    "summary edited": Kind(summary_edited),
    "unsigned: S 3 % off, U x 100, any engine": Kind(unsigned(forged_results), keyed=False),
    "unsigned: one field, a known engine": Kind(unsigned(forged_field), keyed=False),
    "unsigned: calibration edited": Kind(unsigned(edited("Calibration", other_result)), keyed=False),
    "unsigned: engine named otherwise": Kind(unsigned(edited("Event", other_engine)), keyed=False),
    "unsigned: snapshot edited": Kind(unsigned(edited("Event", other_snapshot)), keyed=False),
    "unsigned: samples hostile": Kind(unsigned(edited("RawBlock", hostile_samples)), keyed=False),
}
