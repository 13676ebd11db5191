"""docs/recording.md: a reader who has nothing of this program gets the same samples, and S within its uncertainty."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.proto import fieldcal_pb2 as pb
from agent.recording.raw_block import encode_block
from agent.recording.reading import RecordingReader
from docs import worked_block
from hw.block import SampleBlock
from tests.replay.golden_files import GOLDEN
from tests.unit.recorded_bench import record

PAGE = Path(__file__).parents[2] / "docs" / "recording.md"
SECTION = re.search(r"^## Read it without this program\n(.*?)^## ", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
assert SECTION is not None
CODE = "\n".join(re.findall(r"^```python\n(.*?)^```\n", SECTION[1], re.MULTILINE | re.DOTALL))
READER, _, USE = CODE.partition("S, Q, calibration =")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A minute of the bench: four positions."""
    directory = tmp_path_factory.mktemp("stranger")
    record(directory / "data", 56.0)
    return directory


def run(code: str) -> dict[str, Any]:
    names: dict[str, Any] = {}
    exec(compile(code, "docs/recording.md", "exec"), names)
    return names


def test_it_imports_nothing_of_this_program() -> None:
    named = set(re.findall(r"^(?:from|import) (\w+)", CODE, re.MULTILINE))
    assert named == {"google", "mcap", "numpy", "re"}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["of today", *(f"format-{k}" for k in (1, 2, 3))])
def test_all_samples_and_arrivals_are_those_of_the_program(kind: str, recorded: Path) -> None:
    names = run(READER)
    path = recorded / "data" / "fieldcal-000001.mcap"
    if kind != "of today":
        path = GOLDEN / kind / "fieldcal-000001.mcap"
    blocks = [step.event for step in RecordingReader(path).steps() if isinstance(step.event, SampleBlock)]
    theirs = [message for topic, message in names["messages"](path) if topic.endswith("/raw")]
    assert len(theirs) == len(blocks) > 2
    for block, message in zip(blocks, theirs, strict=True):
        arrival_ns, count = names["bursts"](message)
        np.testing.assert_array_equal(names["samples"](message), block.indications)
        np.testing.assert_array_equal(arrival_ns, block.burst_t_monotonic_ns)
        np.testing.assert_array_equal(count, block.burst_count)


@pytest.mark.parametrize(
    "values",
    [
        np.array([[2**31 - 1], [-(2**31)], [5], [2**31 - 1]], np.int32),  # differences that wrap around
        np.arange(12, dtype=np.int32).reshape(4, 3) ** 5,
        np.arange(3, dtype=np.int32).reshape(1, 3),
        np.array([[0.25, -0.0, 3.5], [1e-05, 2.0, -0.0]]),
        np.full((4, 3), np.pi),
    ],
)
def test_each_kind_of_block_is_read(values: np.ndarray) -> None:
    n = len(values)
    block = SampleBlock("d", "b", 0, 0, 1.0, np.array([2**40]), np.array([n], np.int32), values)
    read = run(READER)["samples"](pb.RawBlock.FromString(encode_block(0, block)))
    assert read.astype(values.dtype).tobytes() == values.tobytes()


def off_by(code: str, monkeypatch: pytest.MonkeyPatch, directory: Path) -> float:
    """The largest difference of an element of S from the published one, in published standard uncertainties."""
    monkeypatch.chdir(directory)
    names = run(code)
    elements = [f"s{row}{column}" for row in "xyz" for column in "xyz"]
    published = np.array([getattr(names["calibration"], name) for name in elements])
    u = np.array([getattr(names["calibration"], f"u_{name}") for name in elements])
    return float(np.max(np.abs(names["S"].ravel() - published) / u))


@pytest.mark.slow
def test_s_by_plain_least_squares_is_the_published_one(
    recorded: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert off_by(CODE, monkeypatch, recorded) < 1.0
    assert re.fullmatch(r"[\d.]+ published: [\d.]+ u: [\d.]+\n", capsys.readouterr().out)


@pytest.mark.one_case
@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("reading[:, 0]", "1.01 * reading[:, 0]"),
        ("np.radians([", "0.035 + np.radians(["),
        ("gravity_mps2=9.80665", "gravity_mps2=0.0"),
        ("s_and_q[:3].T", "s_and_q[:3]"),
        ("(-0.02, 0.02, 0.0002)", "(0.01, 0.012, 0.0002)"),
        ("axis=0", "axis=1"),
    ],
)
def test_a_wrong_answer_is_outside(right: str, wrong: str, recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert right in CODE
    assert off_by(CODE.replace(right, wrong), monkeypatch, recorded) > 1.5


def test_the_worked_block_is_of_the_code_and_any_reader_has_its_samples() -> None:
    text = PAGE.read_text("utf-8")
    assert worked_block.page() == text, "run `.venv/bin/python -m docs.worked_block` and commit what it writes"
    shown = text.partition(worked_block.BEGIN)[2].partition(worked_block.END)[0]
    data = bytes.fromhex("".join(re.findall(r"^((?:[0-9a-f]{2} )*[0-9a-f]{2})(?: |$)", shown, re.MULTILINE)))
    message, names = pb.RawBlock.FromString(data), run(READER)
    said = re.findall(r"\((-?\d+), (-?\d+), (-?\d+)\)", text.partition("A block of three samples")[2])[:3]
    assert names["samples"](message).tolist() == [[int(value) for value in sample] for sample in said]
    arrival_ns, count = names["bursts"](message)
    assert (arrival_ns.tolist(), count.tolist()) == ([5 * 10**9, 5 * 10**9 + 10**7], [2, 3])
    assert (message.order, len(message.differences)) == (1, 2 * 3 * 2)


def test_the_table_of_a_block_has_each_field_with_its_number_and_type() -> None:
    table = PAGE.read_text("utf-8").partition("## The bytes of a block")[2].partition("**The width")[0]
    told: dict[int, tuple[str, str]] = {}
    for numbers, names, kind in re.findall(r"^\| ([\d to]+) \| ([`\w, ]+) \| ([\w ]+) \|", table, re.MULTILINE):
        first = int(numbers.partition(" ")[0])
        told |= {first + k: (name, kind) for k, name in enumerate(re.findall(r"`(\w+)`", names))}
    fields = {field.number: field for field in pb.RawBlock.DESCRIPTOR.fields}
    assert told == {number: (field.name, kind_of(field)) for number, field in fields.items()}


def test_the_fast_form_of_a_block_has_the_same_fields() -> None:
    """RawBlockBytes has byte strings in the place of packed arrays, and else what RawBlock has."""
    plain = [(f.number, f.name, kind_of(f)) for f in pb.RawBlock.DESCRIPTOR.fields]
    fast = [(f.number, f.name, kind_of(f)) for f in pb.RawBlockBytes.DESCRIPTOR.fields]
    assert fast == [(number, name, "bytes" if kind.startswith("packed") else kind) for number, name, kind in plain]


def kind_of(field: Any) -> str:
    kind = {getattr(field, name): name.removeprefix("TYPE_").lower() for name in dir(field) if name.startswith("TYPE_")}
    optional = field.containing_oneof is not None  # proto3 makes an oneof of each optional field
    return ("packed " if field.is_repeated else "optional " if optional else "") + kind[field.type]
