"""Mutants of the code: changes of one operator or number each, drawn alike by package, and which of them tests notice.

    python -m tests.code_mutants draw COPY --count 150 --seed 20261128     changes a clone of the repository
    FC_HITS=hits.txt python -m pytest COPY/tests/unit ...                  in COPY: which tests execute which mutant
    python -m tests.code_mutants run COPY hits.txt                         each mutant with the tests that execute it

All mutants stand in one copy, each beside what it changes; the environment variable FC_MUTANT says which one acts. The
command `run` stops at the first test that fails, or after 75 s of processor time.
"""

from __future__ import annotations

import argparse
import ast
import copy
import json
import os
import random
import resource
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

PACKAGES = ("agent/**/*.py", "calib/**/*.py", "hw/*.py")
LIMIT_S = 75  # of processor time, for a mutant; a sound run of its tests takes less
MOST_TESTS = 150
CHOSEN = "code_mutants.json"
COMPARED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
COMPUTED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
}  # fmt: skip
HOOK = """
def _mutant_acts(k, _seen=set(), _of=__import__("os").environ):
    if "FC_MUTANT" in _of:
        return _of["FC_MUTANT"] == str(k)
    test = _of.get("PYTEST_CURRENT_TEST", "")
    if "FC_HITS" in _of and (k, test) not in _seen:
        _seen.add((k, test))
        with open(_of["FC_HITS"], "a") as file:
            file.write(f"{k}\\t{test}\\n")
    return False
"""


def mutant(e: ast.expr) -> ast.expr | None:
    """What an expression is changed to; None where it has no mutant."""
    changed = copy.deepcopy(e)
    match changed:
        case ast.Compare(ops=[op]) if type(op) in COMPARED:
            changed.ops = [COMPARED[type(op)]()]
        case ast.BinOp(op=op) if type(op) in COMPUTED and not any(_is_text(part) for part in ast.walk(changed)):
            changed.op = COMPUTED[type(op)]()
        case ast.BoolOp(op=op):
            changed.op = ast.Or() if isinstance(op, ast.And) else ast.And()
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return operand
        case ast.Constant(value=bool(value)):
            return ast.Constant(not value)
        case ast.Constant(value=int(value) | float(value)):
            return ast.Constant(value + 1)
        case _:
            return None
    return changed


def _is_text(part: ast.AST) -> bool:
    return isinstance(part, ast.JoinedStr) or (isinstance(part, ast.Constant) and isinstance(part.value, str | bytes))


class Sites(ast.NodeTransformer):
    """Notes the expressions in functions that have a mutant; puts mutants beside those `chosen` (site: number)."""

    def __init__(self, chosen: dict[int, int] | None = None) -> None:
        self.found: list[tuple[int, str, str]] = []  # line, expression, mutant
        self._chosen, self._depth = chosen or {}, 0

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        self._depth += 1
        node.body = [self.visit(statement) for statement in node.body]  # decorators and defaults stay as they are
        self._depth -= 1
        return node

    def visit_JoinedStr(self, node: ast.JoinedStr) -> ast.JoinedStr:
        return node

    def visit_Match(self, node: ast.Match) -> ast.Match:
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AnnAssign:
        node.value = self.visit(node.value) if node.value is not None else None
        return node

    def visit(self, node: ast.AST) -> Any:
        changed = mutant(node) if self._depth and isinstance(node, ast.expr) else None
        if changed is None or not isinstance(node, ast.expr):
            return super().visit(node)
        number = self._chosen.get(len(self.found))
        self.found.append((node.lineno, ast.unparse(node), ast.unparse(changed)))
        whole = super().visit(node)
        if number is None:
            return whole
        acts = ast.Call(ast.Name("_mutant_acts", ast.Load()), [ast.Constant(number)], [])
        return ast.copy_location(ast.IfExp(acts, changed, whole), node)


def draw(root: Path, count: int, seed: int) -> None:
    """Put so many mutants into a clone, each package with its share, and write what they are."""
    sites: defaultdict[str, list[tuple[str, int, int, str, str]]] = defaultdict(list)
    for path in sorted(path for pattern in PACKAGES for path in root.glob(pattern)):
        name = path.relative_to(root)
        if "proto" in name.parts or "_pb2" in name.name:
            continue
        every = Sites()
        every.visit(ast.parse(path.read_text()))
        sites["/".join(name.parts[: 2 if len(name.parts) > 2 else 1])] += [
            (str(name), k, *found) for k, found in enumerate(every.found)
        ]
    total, drawn = sum(map(len, sites.values())), random.Random(seed)
    share = {package: count * len(of) / total for package, of in sites.items()}
    taken = {package: int(part) for package, part in share.items()}
    for package in sorted(share, key=lambda p: taken[p] - share[p])[: count - sum(taken.values())]:
        taken[package] += 1
    chosen = [site for package in sorted(sites) for site in sorted(drawn.sample(sites[package], taken[package]))]
    by_file: defaultdict[str, dict[int, int]] = defaultdict(dict)
    for number, (file, k, *_) in enumerate(chosen):
        by_file[file][k] = number
    for file, own in by_file.items():
        tree: ast.Module = Sites(own).visit(ast.parse((root / file).read_text()))
        future = [k for k, s in enumerate(tree.body) if isinstance(s, ast.ImportFrom) and s.module == "__future__"]
        at = max(future, default=-1) + 1
        tree.body[at:at] = ast.parse(HOOK).body
        (root / file).write_text(ast.unparse(ast.fix_missing_locations(tree)) + "\n")
    told = [{"file": name, "line": line, "from": a, "to": b} for name, _, line, a, b in chosen]
    (root / CHOSEN).write_text(json.dumps(told, indent=0))


def run(root: Path, hits: Path) -> None:
    """Say of each mutant whether a test that executes it fails."""
    tests: defaultdict[int, set[str]] = defaultdict(set)
    for line in hits.read_text().splitlines():
        executed, _, test = line.partition("\t")
        if "::" in test:
            tests[int(executed)].add(test.rsplit(" (", 1)[0])
    counts: defaultdict[str, int] = defaultdict(int)
    for number, told in enumerate(json.loads((root / CHOSEN).read_text())):
        said = "not executed"
        if own := sorted(tests[number])[:MOST_TESTS]:
            done = subprocess.run(
                [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--tb=no", *own],
                cwd=root, env=os.environ | {"PYTHONPATH": str(root), "FC_MUTANT": str(number)}, check=False,
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_S, LIMIT_S)),
            )  # fmt: skip
            said = "survives" if done.returncode == 0 else "killed"
        counts[said] += 1
        print(f"{number} {said}: {told['file']}:{told['line']}: {told['from'][:60]} -> {told['to'][:60]}", flush=True)
    print(dict(counts))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    drawing, running = commands.add_parser("draw"), commands.add_parser("run")
    for command in (drawing, running):
        command.add_argument("copy", type=Path)
    drawing.add_argument("--count", type=int, default=150)
    drawing.add_argument("--seed", type=int, required=True)
    running.add_argument("hits", type=Path)
    args = parser.parse_args()
    if args.command == "draw":
        draw(args.copy.resolve(), args.count, args.seed)
    else:
        run(args.copy.resolve(), args.hits)


if __name__ == "__main__":
    main()
