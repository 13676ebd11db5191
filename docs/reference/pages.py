"""The reference pages, made from the code: configuration, drivers, commands, messages, reasons, `import calib`.

`.venv/bin/python -m docs.reference.pages` writes them; `tests/unit/test_docs_site.py` fails when one is stale.
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import msgspec
from pydantic import BaseModel

from docs.reference.window_numbers import NUMBERS, THRESHOLD

if TYPE_CHECKING:
    from agent.terminal.window_reasons import Stage

HERE = Path(__file__).parent
WIDTH = 100
UNITS = {
    "_s": "s", "_ns": "ns", "_hz": "Hz", "_khz": "kHz", "_mps2": "m/s²", "_deg": "°", "_degc": "°C", "_rad": "rad",
    "_pct": "%", "_per_k": "1/K", "_days": "d", "_years": "a", "_bytes": "byte",
}  # fmt: skip


def written() -> dict[str, str]:
    """All pages by their file name."""
    makers = (configuration, drivers, commands, messages, reasons, python)
    return {f"{maker.__name__}.md": "\n".join(maker()).rstrip() + "\n" for maker in makers}


def configuration() -> Iterator[str]:
    """Every section and every setting of a configuration file."""
    from agent.config.whole import Config

    yield from _head(
        "Configuration",
        "find each setting of a configuration, with its unit, default and limits",
        "Every section and every setting of the file that `fieldcal run` reads. `fieldcal check` tests a file, "
        "`fieldcal init` writes one; [gateway.md](../gateway.md#2-configuration) explains how to begin.",
    )
    yield from _sections(Config, "", set())


def _sections(model: type[BaseModel], path: str, seen: set[type]) -> Iterator[str]:
    inner: list[tuple[str, type[BaseModel]]] = []
    if path:
        yield from [f"## `[{path}]`", "", _flat(model.__doc__), ""]
    rows = []
    said = _comments(model)
    for name, field in model.model_fields.items():
        models = _models(field.annotation)
        inner += [(f"{path}.{name}".lstrip("."), found) for found in models if found not in seen]
        default = "required" if field.is_required() else _value(field.get_default(call_default_factory=True))
        kind = "section" if models else _type(field.annotation)
        limits = ", ".join(str(limit) for limit in field.metadata if hasattr(limit, "__dataclass_fields__"))
        meaning = field.description or said.get(name, "") or (_flat(models[0].__doc__).split("\n")[0] if models else "")
        text = "; ".join(part.rstrip(".") for part in (meaning, _limits(limits)) if part)
        rows.append((f"`{name}`", kind, _unit(name), "" if models and not field.is_required() else default, text))
    yield from _table(("setting", "type", "unit", "default", "meaning"), rows)
    for name, found in inner:
        if found not in seen:
            seen.add(found)
            yield from _sections(found, name, seen)


def drivers() -> Iterator[str]:
    """Every driver that comes with fieldcal, with its options."""
    from agent.cli.sensors import as_lines
    from agent.setup.drivers import describe
    from hw.sensor import BUILT_IN

    yield from _head(
        "Drivers",
        "find each option of each driver",
        "What `fieldcal sensors` prints: the drivers that come with fieldcal, each with its options: name, unit, "
        "default, values, meaning. [devices.md](../devices.md#which-driver) says which device needs which driver.",
    )
    for name in sorted(BUILT_IN):
        head, *rows = as_lines(describe(name))
        says = head.partition(": ")[2]
        table = textwrap.dedent("\n".join(rows))
        yield from [f"## {name}", "", says[:1].upper() + says[1:], "", "```text", table, "```", ""]


def commands() -> Iterator[str]:
    """Every command with its options."""
    from agent.cli.main import fieldcal

    yield from _head("Commands", "find each option of each command", "What `fieldcal COMMAND --help` prints.")
    settings = fieldcal.context_settings | {"terminal_width": WIDTH, "max_content_width": WIDTH}
    context = click.Context(fieldcal, info_name="fieldcal", **settings)
    yield from _helps(fieldcal, context)


def _helps(command: click.Command, context: click.Context) -> Iterator[str]:
    yield from [f"## {context.command_path}", "", "```text", command.get_help(context), "```", ""]
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found is not None
            inner = click.Context(found, parent=context, info_name=name, terminal_width=WIDTH, max_content_width=WIDTH)
            yield from _helps(found, inner)


def messages() -> Iterator[str]:
    """All fields of all results and events."""
    from agent.core import events
    from agent.delivery import guide

    yield from _head(
        "Messages",
        "read each field of a result, an event or a message",
        "Every field of every result (published over Zenoh as JSON under `fieldcal/v1/SITE/GATEWAY/SENSOR/WHAT`, and "
        "recorded), of every event (recorded under `/events`), and of the guide of `fieldcal bench`. "
        "[recording.md](../recording.md) explains the file, "
        "[online.md](../online.md) what the results mean.",
    )
    common = events.Result
    yield from ["## In every result", "", *_fields(common, set())]
    own = set(common.__struct_fields__)
    for what, kind in sorted(events.RESULTS.items()):
        yield from [f"## Result `{what}`", "", _flat(kind.__doc__), "", *_fields(kind, own)]
        if kind is events.WindowReport:
            yield from _numbers()
    for kind in (events.BandResponse, events.SteadySensitivity, events.SharedError):
        yield from [f"## Part `{kind.__name__}`", "", _flat(kind.__doc__), "", *_fields(kind, set())]
    for kind in (
        events.RunStart,
        events.DeviceChange,
        events.Gap,
        events.SelfTestRun,
        events.Command,
        events.Pruned,
        events.Tick,
    ):
        yield from [f"## Event `{kind.__name__}`", "", _flat(kind.__doc__), "", *_fields(kind, set())]
    yield from ["## The guide of fieldcal bench", "", _flat(guide.Guide.__doc__), ""]
    yield from [
        f"JSON under `fieldcal/v1/SITE/GATEWAY/{guide.WHAT}`, at most {guide.LARGEST_GUIDE >> 10} KiB, neither kept "
        f"nor recorded. A text has at most {guide.TEXT_MAX} characters.",
        "",
        *_fields(guide.Guide, set()),
    ]
    parts = (guide.Expanded, guide.NextStop, guide.Staying, guide.TakenStop, guide.Warned, guide.Ending, guide.MadeFile)
    for kind in parts:
        yield from [f"## Part `{kind.__name__}`", "", _flat(kind.__doc__), "", *_fields(kind, set())]


def _numbers() -> Iterator[str]:
    """What stands in the `numbers` of a window."""
    yield from [
        f"`numbers` has those of these names that apply; a name with `{THRESHOLD}` at its end is the limit of the "
        "statistic, and one that begins with `u_` its standard uncertainty.",
        "",
    ]
    rows = [(f"`{names.replace(', ', '`, `')}`", _unit(names), meaning) for names, meaning in NUMBERS.items()]
    yield from _table(("name", "unit", "meaning"), rows)


def reasons() -> Iterator[str]:
    """Why windows are refused or held, and what helps."""
    from agent.terminal.window_reasons import HELD, REFUSED

    yield from _head(
        "Refused and held windows",
        "find what the reason of a refused or held window means, and what to do",
        "Every reason that a running agent gives for a window that it does not use: in the log, on the terminal, on "
        "the fleet page, and in `reason` of the result `window`; the status says once the reason of the third window "
        "that was refused in a row, that windows are used again, and each fault of the program. `#` stands for a "
        "number or a name. The line `next:` says what stands under *do*. Settings are those of `[[channels]]` "
        "([configuration.md](configuration.md)); the [numbers](messages.md#result-window) of the window have each "
        "statistic beside its limit.",
    )
    yield from _paragraph(
        "A refused window changes nothing, and the agent goes on with the next one: a few are normal. A window meets "
        "the reasons from top to bottom, and the first one that applies is told. A fault of the program can come "
        "anywhere. A lag that would explain the window is told behind the reason."
    )
    yield from ["## Refused windows", ""]
    for stage in REFUSED:
        yield from [f"### {stage.title}", "", *_remedies(stage)]
    yield from ["## Held windows", ""]
    yield from _paragraph(
        "A window that is held is kept aside until further windows confirm it, and the status is HELD. Its reason has "
        "several parts, with a semicolon between them. [gate.md](../gate.md) has the rules, and what the "
        "status says when HELD does not end."
    )
    yield from _remedies(HELD)


def _remedies(stage: Stage) -> Iterator[str]:
    rows = [
        (
            "<br>".join(_sentence(s) for s in one.sentences),
            _capital(one.means),
            _capital(one.do),
            ", ".join(f"`{setting}`" for setting in one.settings),
        )
        for one in stage.reasons
    ]
    yield from _table(("reason, or its beginning", "means", "do", "settings"), rows)


def _sentence(pattern: str) -> str:
    return f"*{pattern.partition('; ')[0].replace('{}', '#')}*"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _fields(kind: type[msgspec.Struct], left_out: set[str]) -> Iterator[str]:
    said = _comments(kind)
    rows = [
        (f"`{field.name}`", _type(field.type), _unit(field.name), said.get(field.name, ""))
        for field in msgspec.structs.fields(kind)
        if field.name not in left_out
    ]
    yield from _table(("field", "type", "unit", "meaning"), rows)


def python() -> Iterator[str]:
    """The names of `import calib`, from their docstrings."""
    import calib

    yield from _head(
        "`import calib`",
        "call each public name of `calib`",
        "All public names with their docstrings. [api.md](../api.md) shows how they work together, with examples that "
        "run as tests.",
    )
    for name in sorted(calib.__all__, key=str.lower):
        found = getattr(calib, name)
        if inspect.isclass(found) or inspect.isfunction(found):
            yield from [f"## {name}", "", "```python", _signature(name, found), "```", ""]
            yield from ["```text", inspect.getdoc(found) or "", "```", ""]


def _signature(name: str, found: Any) -> str:
    try:
        text = re.sub(r"<factory>|<object object at 0x[0-9a-f]+>", "...", str(inspect.signature(found)))
    except ValueError:
        return name
    text = re.sub(r"\b(?:[A-Za-z_]\w*\.)+(\w+)", r"\1", text).replace("'", "")
    if len(name + text) <= WIDTH:
        return name + text
    inside, _, after = text[1:].rpartition(")")
    parts = re.split(r", (?![^\[(]*[\])])", inside)
    return f"{name}(\n" + "".join(f"    {part},\n" for part in parts) + ")" + after


def _head(title: str, after: str, text: str) -> list[str]:
    """Title, what the reader can do after the page, and an introduction."""
    made = "<!-- made from the code by `python -m docs.reference.pages`; do not edit -->"
    return [f"# {title}", "", f"After this page you can {after}.", "", made, "", *_paragraph(text)]


def _paragraph(text: str) -> list[str]:
    return [*textwrap.wrap(text, WIDTH + 20, break_on_hyphens=False), ""]  # a link is not broken


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> Iterator[str]:
    if rows:
        for row in (head, ("---",) * len(head), *rows):
            yield "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |"
        yield ""


def _comments(kind: type) -> dict[str, str]:
    """What the source says of each field: the comment in its lines, or the comment lines above it."""
    found: dict[str, str] = {}
    for cls in kind.__mro__:
        if cls.__module__.partition(".")[0] not in ("agent", "calib", "hw") or "__annotations__" not in vars(cls):
            continue
        lines = inspect.getsource(cls).split("\n")
        tree = ast.parse(textwrap.dedent("\n".join(lines))).body[0]
        assert isinstance(tree, ast.ClassDef)
        for node in tree.body:
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                last = lines[(node.end_lineno or node.lineno) - 1]
                above, at = [], node.lineno - 2
                while lines[at].lstrip().startswith("# "):
                    above.insert(0, lines[at].strip().removeprefix("# "))
                    at -= 1
                said = last[(node.end_col_offset or 0) :].partition("# ")[2] or " ".join(above)
                found.setdefault(node.target.id, said.partition("type: ignore")[0].strip())
    return found


def _models(annotation: Any) -> list[type[BaseModel]]:
    """The sections in a type, also inside tuples, unions and Annotated."""
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for part in getattr(annotation, "__args__", ()) for found in _models(part)]


def _type(annotation: Any) -> str:
    if annotation is type(None):
        return "none"
    if inspect.isclass(annotation) and not getattr(annotation, "__args__", ()):
        return {"str": "text", "int": "whole number", "float": "number", "bool": "true or false"}.get(
            annotation.__name__, f"`{annotation.__name__}`"
        )
    origin, parts = str(getattr(annotation, "__origin__", "")), getattr(annotation, "__args__", ())
    if "Literal" in origin:
        return ", ".join(f"`{part}`" for part in parts)
    kinds = [_type(part) for part in parts if part is not type(None) and part is not Ellipsis]
    if "UnionType" in type(annotation).__name__ or "Union" in origin:
        return " or ".join(kinds)
    if "dict" in origin:
        return f"{kinds[1]} by {kinds[0]}"
    if "Annotated" in type(annotation).__name__:
        return kinds[0] if kinds else str(annotation)
    if len(kinds) > 1 and len(set(kinds)) == 1:
        return f"{len(kinds)} × {kinds[0]}"
    return f"list of {kinds[0]}" if kinds else str(annotation).rpartition(".")[2]


def _unit(name: str) -> str:
    return next((unit for suffix, unit in sorted(UNITS.items(), key=lambda s: -len(s[0])) if name.endswith(suffix)), "")


def _value(value: Any) -> str:
    if isinstance(value, BaseModel):
        return ""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    return f"`{list(value) if isinstance(value, tuple) else value}`" if value != "" else '`""`'


def _limits(text: str) -> str:
    signs = {"gt": "> ", "ge": "≥ ", "lt": "< ", "le": "≤ "}
    found = re.findall(r"(Gt|Ge|Lt|Le)\(\w+=([^)]+)\)", text)
    found += [("min", length) for length in re.findall(r"MinLen\(min_length=(\d+)\)", text)]
    return ", ".join(f"{signs.get(kind.lower(), 'at least ')}{value}" for kind, value in found)


def _flat(text: str | None) -> str:
    """A docstring without its line breaks within paragraphs."""
    return "\n\n".join(" ".join(part.split()) for part in inspect.cleandoc(text or "").split("\n\n"))


if __name__ == "__main__":
    for name, text in written().items():
        (HERE / name).write_text(text, "utf-8")
