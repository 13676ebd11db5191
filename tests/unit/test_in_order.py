"""Recordings that are read as one: of one gateway, each once, the oldest first, however they are given."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from agent.core.events import RunStart, Tick
from agent.export.at_the_end import in_order_of as to_export
from agent.export.samples import ExportError
from agent.recording.in_order import OrderError, in_order, of_one_gateway
from agent.recording.signing import Signer
from agent.recording.writer import Recorder
from agent.report.recorded import RecordingError
from agent.report.recorded import in_order_of as to_report
from tests.replay.stand_in import CONFIG, StandIn, record_run, run_start

START = run_start(StandIn(CONFIG), 0, 1)
SECOND = 10**9


def test_the_number_tells_the_order_whatever_the_clock_showed() -> None:
    """The clock was an hour late, then right, then in 1970."""
    times = {1: START.t_utc_ns + 3600 * SECOND, 2: START.t_utc_ns, 3: 0}
    starts = [
        (Path(f"{n}.mcap"), msgspec.structs.replace(START, file_sequence=n, t_utc_ns=t)) for n, t in times.items()
    ]
    for given in (starts, starts[::-1], [starts[1], starts[0], starts[2]]):
        assert [path.name for path in in_order(given)] == ["1.mcap", "2.mcap", "3.mcap"]


def test_the_time_tells_the_order_where_numbers_began_anew() -> None:
    starts = [
        (Path(f"{hour}.mcap"), msgspec.structs.replace(START, file_sequence=n, t_utc_ns=3600 * SECOND * hour))
        for hour, n in ((3, 1), (1, 1), (2, 2))
    ]
    assert [path.name for path in in_order(starts)] == ["1.mcap", "2.mcap", "3.mcap"]


@pytest.mark.parametrize("path", [Path("a.mcap"), Path("b.mcap")])
def test_a_recording_that_is_there_twice_is_refused(path: Path) -> None:
    with pytest.raises(OrderError, match=rf"a\.mcap: {path} is the same recording; give it once"):
        in_order([(Path("a.mcap"), START), (path, START)])


def test_recordings_of_several_gateways_are_refused() -> None:
    other = msgspec.structs.replace(START, gateway="another", run_id="run-2")
    with pytest.raises(OrderError, match="of several gateways, site/another, site/gateway; give those of one"):
        in_order([(Path("a.mcap"), START), (Path("b.mcap"), other)])


def test_report_and_export_put_them_in_order(tmp_path: Path) -> None:
    record_run(tmp_path, rotate_at=(9, 20))
    paths = sorted(tmp_path.glob("*.mcap"))
    assert to_report(paths[::-1]) == to_export(paths[::-1]) == paths
    with pytest.raises(RecordingError, match="is the same recording"):
        to_report([paths[0], paths[0]])
    with pytest.raises(ExportError, match="is the same recording"):
        to_export([paths[0], paths[0]])


def recorded(
    directory: Path, epoch: str, *spans_s: tuple[int, int], signer: Signer | None = None
) -> list[tuple[Path, RunStart]]:
    """Recordings of one store, each from one second to another, with their first events."""
    directory.mkdir()
    recorder = Recorder(directory, ["acc"], ["bridge-1"], epoch=epoch, signer=signer)
    starts = []
    for run, (begin_s, end_s) in enumerate(spans_s):
        start = msgspec.structs.replace(
            START, run_id=f"{epoch}-{run}", file_sequence=recorder.next_file_sequence, t_utc_ns=begin_s * SECOND,
            event_sequence=0, continuation=False,
        )  # fmt: skip
        assert recorder.record(0, start, []), recorder.fault
        assert recorder.record(1, Tick(t_monotonic_ns=end_s * SECOND, t_utc_ns=end_s * SECOND), []), recorder.fault
        recorder.close()
        starts.append(start)
    return list(zip(sorted(directory.glob("*.mcap")), starts, strict=True))


@pytest.mark.parametrize("spans_s", [[(100, 200), (150, 250)], [(100, 200), (120, 130)]])
def test_two_gateways_of_one_name_that_record_at_the_same_time_are_refused(
    tmp_path: Path, spans_s: list[tuple[int, int]]
) -> None:
    both = [one for name, span in zip("ab", spans_s, strict=True) for one in recorded(tmp_path / name, name * 16, span)]
    told = r"b/fieldcal-000001.mcap: it is of another gateway than .+a/fieldcal-000001.mcap, though both are called "
    with pytest.raises(OrderError, match=told + "site/gateway: both recorded at the same time; give"):
        of_one_gateway(both[::-1])


def test_two_gateways_of_one_name_that_take_turns_are_refused(tmp_path: Path) -> None:
    turns = recorded(tmp_path / "a", "a" * 16, (100, 200), (300, 400)) + recorded(tmp_path / "b", "b" * 16, (220, 280))
    with pytest.raises(OrderError, match="both recorded at the same time"):
        of_one_gateway(turns)


def test_two_gateways_of_one_name_with_two_keys_are_refused(tmp_path: Path) -> None:
    both = [
        one
        for name, span in (("a", (100, 200)), ("b", (300, 400)))
        for one in recorded(tmp_path / name, name * 16, span, signer=Signer(Ed25519PrivateKey.generate()))
    ]
    with pytest.raises(OrderError, match="though both are called site/gateway: they sign with two keys"):
        of_one_gateway(both)


def test_a_gateway_that_lost_its_store_or_changed_its_key_is_one(tmp_path: Path) -> None:
    signers = [Signer(Ed25519PrivateKey.generate()) for _ in range(2)]
    lost = [
        one
        for name, span in (("a", (100, 200)), ("b", (300, 400)))
        for one in recorded(tmp_path / name, name * 16, span, signer=signers[0])
    ]
    assert of_one_gateway(lost[::-1]) == [path for path, _ in lost]
    other_key = [
        (path, msgspec.structs.replace(start, file_sequence=3 + k))
        for k, (path, start) in enumerate(recorded(tmp_path / "c", "b" * 16, (500, 600), signer=signers[1]))
    ]
    assert of_one_gateway(lost[1:] + other_key) == [lost[1][0], other_key[0][0]]
