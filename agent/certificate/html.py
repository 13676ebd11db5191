"""The certificate as one HTML page, which loads nothing and runs no script."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator
from importlib.resources import files

from agent.certificate import wording
from agent.certificate.content import ResultCertificate
from agent.certificate.figures import figure, figures_of
from agent.report import style, tables
from agent.terminal.text import page_text


def page(c: ResultCertificate, signature: str) -> str:
    """The whole page. Its policy (CSP) allows only its own style, by its hash, and pictures inside the page."""
    css = "\n" + files("agent.report").joinpath("page.css").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(css.encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'sha256-{digest}'; img-src data:; form-action 'none'; base-uri 'none'"
    body = "\n".join(_body(c, signature))
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{page_text(c.number)}</title>\n<style>{css}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _body(c: ResultCertificate, signature: str) -> Iterator[str]:
    yield f"<h1>{page_text(c.stated.title)}</h1>"
    for section in wording.before_results(c, signature):
        yield _section(section)
    yield "<h2>Results</h2>" + tables.table(wording.HEADS, wording.parameters(c))
    for section in wording.after_results(c):
        yield _section(section)
    yield '<h2>Figures</h2>\n<div class="figures">'
    with style.drawing():
        for caption, height_in, draw in figures_of(c):
            svg = style.svg(figure(c, height_in, draw)).encode()
            source = f"data:image/svg+xml;base64,{base64.b64encode(svg).decode()}"
            text = page_text(caption)
            yield f'<figure><img src="{source}" alt="{text}"><figcaption>{text}</figcaption></figure>'
    yield "</div>"


def _section(section: wording.CertificateSection) -> str:
    table = tables.table(("", ""), section.rows, "words", frozenset({1}))
    return f"<h2>{page_text(section.heading)}</h2>{table}"
