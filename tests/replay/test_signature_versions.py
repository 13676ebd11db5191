"""Recordings signed by older versions pass the audit as their format allows, and a changed byte in them is seen."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from agent.audit.engines import Engines
from agent.cli.audit import run_audit
from agent.cli.given import recordings_of
from agent.config.known_keys import KnownKeys
from agent.recording.signing import load_public_key
from tests.replay.forgery import with_sums
from tests.replay.stand_in import StandIn

SIGNATURES = Path(__file__).parent / "signatures"
VERSIONS = sorted(SIGNATURES.iterdir())


def audited(files: list[Path], key: Path) -> tuple[int, str]:
    runner = CliRunner()
    with runner.isolation() as (out, _, _):
        given, public = recordings_of(files), load_public_key(key)
        return run_audit(
            given, Engines(StandIn.restore), as_json=False, keys=KnownKeys(anywhere=(public.public_bytes_raw(),))
        ), out.getvalue().decode()


@pytest.mark.parametrize("version", VERSIONS, ids=lambda path: path.name)
def test_a_recording_of_each_version_of_the_signature_passes(version: Path, tmp_path: Path) -> None:
    files = sorted(version.glob("*.mcap"))
    for given in (files, [version]):
        status, text = audited(given, version / "gateway.pub")
        assert (status, "FAILED" in text) == (4, False), text  # whole, but made by an engine of that time
    assert ("results signed" in text) == version.name.endswith("-results")
    data = files[0].read_bytes()
    at = data.index(b"previous_sha256")
    forged = tmp_path / files[0].name
    forged.write_bytes(with_sums(data[:at] + b"P" + data[at + 1 :]))
    status, text = audited([forged], version / "gateway.pub")
    assert status == 3
    assert "its signature is of other bytes" in text
