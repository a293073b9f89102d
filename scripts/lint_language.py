#!/usr/bin/env python3
"""Check the language of code and docs: ``lint_language.py [PATH ...]``, by default every file that git tracks.

Two rules. A docstring opens with a verb or with a noun phrase that stands alone, not with a fragment ("Of the scene",
"What is left"). Names and sentences use the field's words, not words that only this project knows.
"""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

FRAGMENT = re.compile(
    r"(?:Also|And|As|At|But|By|For|From|If|In|Into|Its|Known|Likewise|Not|Of|On|Or|Ours|Per|Same|Such|Than|That|Their|"
    r"Then|Those|To|Told|Until|What|Where|Which|Why|With|The same)\b"
)
"""Openings that leave a docstring without a subject."""

SUFFIXES = {".css", ".html", ".js", ".json", ".md", ".mjs", ".py", ".svg", ".toml", ".ts", ".yml", ".yaml", ""}

PRIVATE_WORDS = re.compile(
    r"(?<![a-z])(?:"
    r"anatomy|at hand|bells?|bold(?![\x22\]]| green)|charges|critics?|economy|envelopes?|exams?|followers?|foretold|"
    r"gloss(?:y|ier)?|"
    r"hedge[sd]?|hopeless|hurry|janitor|judg(?:e[sd]?|ing|ement)|learners?|lessons?|likeness|modest|negligible|"
    r"outlook|peers?|photographers?|pictures?|pictured|prices?|priced|regrets?|school|semantics|shots?|spare|springs?|"
    r"survey|tam(?:ed|es|ing)|taught|teachers?|tickets?|told|trainees?|wander(?:s|ing)?|weigh(?:s|ed|ing)?|"
    r"where that can be"
    r")(?![a-z])",
    re.IGNORECASE,
)
"""Words with a plain equivalent in the field; camelCase and snake_case parts count as words."""

IGNORED = re.compile(r"scripts/lint_language\.py|LICENSE|.*/package-lock\.json|.*constraints.*")


def main(arguments: list[str]) -> int:
    """Print each finding as ``path:line: text``; exit status 1 if there is any."""
    listed = subprocess.run(["git", "ls-files", "--", *arguments], check=True, capture_output=True, text=True)
    paths = [Path(line) for line in listed.stdout.splitlines() if not IGNORED.fullmatch(line)]
    findings = [finding for path in paths if path.suffix in SUFFIXES and path.is_file() for finding in check(path)]
    sys.stdout.writelines(f"{finding}\n" for finding in findings)
    return 1 if findings else 0


def check(path: Path) -> Iterator[str]:
    """Yield the findings of one file."""
    text = path.read_text(encoding="utf-8")
    for number, line in enumerate(text.splitlines(), 1):
        for match in PRIVATE_WORDS.finditer(re.sub(r"([a-z])([A-Z])", r"\1 \2", line)):
            yield f"{path}:{number}: the word '{match.group()}'"
    if path.suffix == ".py":
        for number, docstring in docstrings(text):
            if match := FRAGMENT.match(docstring):
                yield f"{path}:{number}: a docstring opens with the fragment '{match.group()} …'"


def docstrings(source: str) -> Iterator[tuple[int, str]]:
    """Yield the line and the text of every docstring, those of attributes included."""
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Expr(value=ast.Constant(value=str(text)), lineno=number):
                yield number, text.strip()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
