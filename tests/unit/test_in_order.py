"""Recordings that are read as one: of one gateway, each once, the oldest first, however they are given."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from agent.export.at_the_end import in_order_of as to_export
from agent.export.samples import ExportError
from agent.recording.in_order import OrderError, in_order
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
