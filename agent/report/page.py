"""The report as one HTML page, which contains its style, its figures and all numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from importlib.resources import files

from agent import __version__
from agent.report import tables
from agent.report.figures import DrawnFigure
from agent.report.material import Material
from agent.report.result import CalibrationResult
from agent.report.trace import Residuals
from agent.report.units import offset_unit, reference_name, sensitivity_unit
from agent.terminal.text import page_text
from calib.output_unit import ACCELERATION


def page(material: Material, figures: Sequence[DrawnFigure], seen: Sequence[Residuals]) -> str:
    """The whole page. `seen`: residuals of the traced windows for the first result."""
    style = files("agent.report").joinpath("page.css").read_text(encoding="utf-8")
    title = f"Calibration of {material.sensor}" if material.sensor else "Calibration"
    body = "\n".join([*_head(title, material), *_figures(figures), *_numbers(material, seen), *_origin(material)])
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{page_text(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _head(title: str, material: Material) -> Iterator[str]:
    yield f"<h1>{page_text(title)}</h1>"
    for notice in material.notices:
        yield f'<div class="box">{page_text(notice)}</div>'
    for result in material.results:
        several = len(material.results) > 1
        if several:
            yield f"<h2>{page_text(result.label)}</h2>"
        yield from _summary(result, several=several)


def _summary(result: CalibrationResult, *, several: bool) -> Iterator[str]:
    status = "refused" if result.refused else "valid"
    method = "" if several or not result.fields.get("method") else f", {page_text(result.label)}"
    beside = f", beside a {reference_name(quantity)}" if (quantity := result.fields.get("reference_quantity")) else ""
    yield f'<p><span class="status {status}">{status.upper()}</span>{method}{page_text(beside)}</p>'
    if identity := result.fields.get("identity"):
        yield f'<p class="soft">of {page_text(str(identity))}</p>'
    if result.warnings:
        yield _box("Warning", result.warnings)
    if result.reasons:
        yield _box("Refused, because" if result.refused else "Please note", result.reasons)
    if not result.determined.any():
        return
    yield tables.matrix(result.in_display_units)
    unit, kind = offset_unit(result.unit), result.fields.get("uncertainty_kind")
    s_unit = sensitivity_unit(result.unit)
    s_words = f"S without a dimension, in {unit} per {ACCELERATION}" if s_unit == "1" else f"S in {s_unit}"
    factors = sorted({f"{k:.3g}" for k in result.coverage_factor[result.determined]})
    words = f"{s_words}, Q in {unit}. After ±: expanded uncertainty U with k = {' or '.join(factors)}"
    yield f'<p class="soft">{page_text(words)}{f", {page_text(str(kind))}" if kind else ""}.</p>'


def _box(heading: str, sentences: Sequence[str]) -> str:
    listed = "".join(f"<li>{page_text(sentence)}</li>" for sentence in sentences)
    return f'<div class="box">{heading}<ul>{listed}</ul></div>'


def _figures(figures: Sequence[DrawnFigure]) -> Iterator[str]:
    if figures:
        yield '<h2>Figures</h2>\n<div class="figures">'
        for drawn in figures:
            svg = drawn.svg.replace("<svg ", f'<svg role="img" aria-label="{page_text(drawn.caption)}" ', 1)
            yield f"<figure>{svg}<figcaption>{page_text(drawn.caption)}</figcaption></figure>"
        yield "</div>"


def _numbers(material: Material, seen: Sequence[Residuals]) -> Iterator[str]:
    for result in material.results:
        about = f", {page_text(result.label)}" if len(material.results) > 1 else ""
        yield f"<h2>Numbers{about}</h2>"
        for heading, there, table in _tables_of(result, seen if result is material.results[0] else ()):
            if there and (content := table()):
                yield f"<h3>{heading}</h3>{content}"


def _tables_of(result: CalibrationResult, seen: Sequence[Residuals]) -> list[tuple[str, bool, Callable[[], str]]]:
    """Heading, whether there is anything to show, and what makes it."""
    fields, determined = result.fields, bool(result.determined.any())
    return [
        ("Parameters", determined, lambda: tables.parameters(result.in_display_units)),
        ("Main sensitivities over frequency, with U", bool(result.frequencies.bands),
         lambda: tables.over_frequency(result.in_display_units)),
        ("Uncertainty budget: u by source", bool(result.budget) and determined,
         lambda: tables.budget(result.in_display_units)),
        ("Nuisances", bool(fields.get("nuisances")), lambda: tables.nuisances(result)),
        ("Statistics (Appendix A)", bool(fields.get("statistics")), lambda: tables.statistics(fields["statistics"])),
        ("Residuals, root mean square", bool(seen), lambda: tables.left_over(seen, result)),
        ("Windows", bool(result.windows), lambda: tables.windows(result)),
        ("Options", True, lambda: tables.facts(fields.get("options") or {})),
        ("Further", True, lambda: tables.facts(result.other_members)),
        ("Covariance", determined, lambda: tables.covariance(result.in_display_units)),
    ]  # fmt: skip


def _origin(material: Material) -> Iterator[str]:
    yield "<h2>Origin</h2>"
    yield tables.facts(material.facts)
    rows = [[file.path, str(file.size_bytes), file.sha256] for file in material.files]
    if rows:
        yield tables.table(["made from", "bytes", "SHA-256"], rows, "words", frozenset({2}))
    yield f'<p class="soft">Written by fieldcal {page_text(__version__)}. report.json contains all numbers too.</p>'
