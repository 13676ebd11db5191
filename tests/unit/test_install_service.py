"""`fieldcal install-service`: what it writes is what deploy/ holds, twice the same, and it can be removed."""

from __future__ import annotations

from pathlib import Path

import pytest

from agent.cli.main import COMMANDS, COMPLETION, run_cli
from agent.setup.service import FILES
from tests.faults.limits import directives
from tests.scenarios.processes import ROOT

PROGRAM = "/srv/fieldcal/bin/fieldcal"
UNIT = "etc/systemd/system/fieldcal.service"


def run(root: Path, *arguments: str) -> int:
    return run_cli(["install-service", "--root", str(root), *arguments])


def lines(capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    """What was done with each file, by its path."""
    said = [line.split() for line in capsys.readouterr().out.splitlines()]
    return {words[1]: words[0] for words in said if len(words) == 2 and words[1].startswith("/")}


def files(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_it_writes_what_deploy_holds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path, "--program", PROGRAM) == 0
    assert set(lines(capsys).values()) == {"written"}
    written = files(tmp_path)
    assert set(written) == {file.target.lstrip("/") for file in FILES}
    for file in FILES:
        text = (ROOT / "deploy" / file.name).read_text().replace("/opt/fieldcal/.venv/bin/fieldcal", PROGRAM)
        assert written[file.target.lstrip("/")].decode() == text
    assert directives(tmp_path / UNIT)["ExecStart"][0].startswith(f"{PROGRAM} run /etc/fieldcal/")


def test_twice_is_as_once_and_what_users_edit_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path, "--program", PROGRAM) == 0
    before = files(tmp_path)
    capsys.readouterr()
    assert run(tmp_path, "--program", PROGRAM) == 0
    assert set(lines(capsys).values()) == {"unchanged"}
    assert files(tmp_path) == before
    router = tmp_path / "etc/fieldcal/router.json5"
    router.write_text("mine")
    (tmp_path / UNIT).write_text("damaged")
    assert run(tmp_path, "--program", PROGRAM) == 0
    done = lines(capsys)
    assert (done[str(router)], done[str(tmp_path / UNIT)]) == ("kept", "changed")
    assert router.read_text() == "mine"
    assert files(tmp_path)[UNIT] == before[UNIT]
    assert run(tmp_path, "--uninstall") == 0
    assert list(files(tmp_path)) == ["etc/fieldcal/router.json5"]
    assert run(tmp_path, "--uninstall") == 0
    assert set(lines(capsys).values()) == {"kept", "absent"}


def test_a_program_that_the_unit_hides(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path, "--program", "/home/anna/.venv/bin/fieldcal") == 2
    assert "the unit hides this directory" in capsys.readouterr().err
    assert files(tmp_path) == {}


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_files_are_those_of_the_program(
    shell: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(COMPLETION, f"{shell}_source")
    assert run_cli([]) == 0
    assert capsys.readouterr().out == (ROOT / "deploy" / "completion" / f"fieldcal.{shell}").read_text()


def test_a_shell_is_told_the_commands(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name, value in {COMPLETION: "bash_complete", "COMP_WORDS": "fieldcal ", "COMP_CWORD": "1"}.items():
        monkeypatch.setenv(name, value)
    assert run_cli([]) == 0
    assert {line.split(",")[1] for line in capsys.readouterr().out.splitlines()} == set(COMMANDS)
