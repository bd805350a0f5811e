"""Check README.md, docs/, docstrings and comments against the style of the project, within a budget that may only fall.

    python tools/prose.py            # print every finding, and the counts beside the budget
    python tools/prose.py --lower    # write lower counts into the budget

Findings: sentences of more than 32 words, words of the list below, sentences that begin with "Who", "What" or "That of"
as their subject, three passives in a row, pages of more than 25 words a sentence on average, pages of more than 2,000
words, and pages that do not begin with what the reader can do. The first page of the site and the README begin with
what fcslam is. Generated pages, code and tables are left out, except that words of the list count in tables, too.

Of docstrings and comments in ``src``, ``tests`` and ``examples``, the first three kinds count, with "in code" in their
names. Indented blocks of docstrings, such as formats and diagrams, are left out.
"""

import argparse
import ast
import inspect
import io
import json
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
BUDGET = ROOT / "tools" / "prose_budget.json"
GENERATED = {"commands.md", "rest.md", "settings.md", "settings-robot.md", "settings-lidar.md", "settings-training.md"}

LONGEST_SENTENCE = 32
MEAN_SENTENCE = 25
LONGEST_PAGE = 2000
"""Words of a page with its tables and code."""
WORDS = ("borne out", "anew", "alike", "told", "as it comes", "says so", "is worth")
"""Words and phrases that the project does not use."""
OPENING = re.compile(r"(?:Who|What|That of)\b(?![^.!?]*\?)")
"""Beginning of a sentence that has a clause as its subject; questions are fine."""
READER = re.compile(r"\b(?:After this page|With (?:this|these) pages?)\b|^\| you (?:want|have)", re.MULTILINE)
PASSIVE = re.compile(
    r"\b(?:is|are|was|were|be|been|being)\s+(?:\w+ly\s+|not\s+|never\s+|then\s+|also\s+)?"
    r"(?:\w+ed|built|cut|drawn|found|given|held|kept|known|laid|left|lost|made|put|read|seen|sent|shown|taken|written)\b"
)
CHAIN = 3
"""Passives in a row of sentences that make a chain."""

FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
DROPPED = re.compile(r"^(?: {4}.*|\||#|!\[|:::|<|\[!).*$", re.MULTILINE)
LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)")
CODE = re.compile(r"`[^`]*`")
BLOCK = re.compile(r"\n\s*\n|\n(?=[-*] |\d+\. )")
ITEM = re.compile(r"\n(?= *[-*] | {4}\S|\w+:$)", re.MULTILINE)
"""Beginning of an item of a list or of a section of a docstring."""
COLUMNS = re.compile(r"\S {3,}\S")
"""Text in columns, such as a format."""
SECTION = re.compile(r"(?:Args|Returns|Raises|Yields|Attributes):$", re.MULTILINE)
SENTENCE = re.compile(r"(?<=[.!?:;])[\"')*]*\s+(?=[A-Z`*\"(\[]|fcslam )")


def sentences(text: str) -> Iterator[str]:
    """The sentences of a page, without code, tables, headings and pictures."""
    text = LINK.sub(r"\1", DROPPED.sub("", FENCE.sub("", text)))
    for block in BLOCK.split(text):
        words = " ".join(block.split()).lstrip("-* ")
        yield from filter(None, SENTENCE.split(words))


def words_of(sentence: str) -> int:
    """The number of words; a piece of code counts one."""
    return len(CODE.sub("code", sentence).split())


def findings(text: str) -> Iterator[tuple[str, str]]:
    """Kind and place of each finding of a page."""
    all_sentences = list(sentences(text))
    passives = 0
    for sentence in all_sentences:
        if words_of(sentence) > LONGEST_SENTENCE:
            yield "long sentences", sentence
        if OPENING.match(sentence):
            yield "clauses as subjects", sentence
        passives = passives + 1 if PASSIVE.search(sentence) else 0
        if passives == CHAIN:
            yield "passive chains", sentence
            passives = 0
    prose = CODE.sub("code", LINK.sub(r"\1", FENCE.sub("", text)))
    for phrase in WORDS:
        for match in re.finditer(rf"\b{phrase}\b", prose, re.IGNORECASE):
            yield "words", f"{phrase}: {' '.join(prose[max(0, match.start() - 40) : match.end() + 20].split())}"
    lengths = [words_of(sentence) for sentence in all_sentences]
    if lengths and sum(lengths) > MEAN_SENTENCE * len(lengths):
        yield "pages with long sentences", f"{sum(lengths) / len(lengths):.1f} words on average"
    if len(text.split()) > LONGEST_PAGE:
        yield "long pages", f"{len(text.split())} words"
    if not text.startswith("# fcslam\n") and not READER.search(text[:900]):
        yield "pages that do not begin with the reader", text.partition("\n")[0]


def pages() -> list[Path]:
    """README.md and every page of docs/ that is written by hand."""
    return [
        ROOT / "README.md",
        *(page for page in sorted((ROOT / "docs").rglob("*.md")) if page.name not in GENERATED),
    ]


def docstrings(source: str) -> Iterator[str]:
    """The docstrings of modules, classes, functions and attributes."""
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else []:
            match statement:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    yield inspect.cleandoc(text)


def comments(source: str) -> Iterator[str]:
    """The comments; lines that are comments only, one below the other, are one."""
    last, lines = -1, list[str]()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row = token.start[0]
            if lines and (row > last + 1 or not token.line.lstrip().startswith("#")):
                yield "\n".join(lines)
                lines.clear()
            lines.append(token.string.lstrip("#! "))
            last = row
    if lines:
        yield "\n".join(lines)


def sentences_of_code(source: str) -> Iterator[str]:
    """The sentences of docstrings and comments, without indented blocks."""
    for text in (*docstrings(source), *comments(source)):
        for block in re.split(r"\n\s*\n", text.replace("``", "`")):
            if block.startswith("    ") or COLUMNS.search(block):
                continue
            for item in ITEM.split(block):
                yield from filter(None, SENTENCE.split(" ".join(SECTION.sub("", item).split()).lstrip("-* ")))


def findings_in_code(source: str) -> Iterator[tuple[str, str]]:
    """Kind and place of each finding in docstrings and comments."""
    for sentence in sentences_of_code(source):
        if words_of(sentence) > LONGEST_SENTENCE:
            yield "long sentences in code", sentence
        if OPENING.match(sentence):
            yield "clauses as subjects in code", sentence
        prose = CODE.sub("code", sentence)
        if any(re.search(rf"\b{phrase}\b", prose, re.IGNORECASE) for phrase in WORDS):
            yield "words in code", sentence


def code() -> list[Path]:
    """Every Python file whose docstrings and comments count, without generated ones."""
    files = (file for folder in ("src", "tests", "examples") for file in sorted((ROOT / folder).rglob("*.py")))
    return [file for file in files if not file.stem.endswith("_pb2") and file.name != "test_prose.py"]


def counts(report: bool = False) -> Counter[str]:
    """The number of findings of each kind in all pages and files; with ``report``, print each."""
    total: Counter[str] = Counter()
    for files, check in ((pages(), findings), (code(), findings_in_code)):
        for file in files:
            for kind, where in check(file.read_text(encoding="utf-8")):
                total[kind] += 1
                if report:
                    print(f"{file.relative_to(ROOT)}: {kind}: {where}")
    return total


def main() -> int:
    """Print the findings and compare them with the budget."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lower", action="store_true", help="write lower counts into the budget")
    lower = parser.parse_args().lower
    budget: dict[str, int] = json.loads(BUDGET.read_text(encoding="utf-8"))
    found = counts(report=not lower)
    for kind, allowed in budget.items():
        print(f"{kind}: {found[kind]}, allowed {allowed}")
    if lower:
        budget = {kind: min(allowed, found[kind]) for kind, allowed in budget.items()}
        BUDGET.write_text(json.dumps(budget, indent=1) + "\n", encoding="utf-8")
    return int(any(found[kind] > allowed for kind, allowed in budget.items()))


if __name__ == "__main__":
    sys.exit(main())
