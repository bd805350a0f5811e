"""Hooks of MkDocs: files that pages link to, the sources of the figures on the pages of results, and breaks in code.

Pages and pictures outside of ``docs/`` that a page links to become part of the site.

A link such as ``../../benchmarks/results/fuzz.md`` works in a clone of the repository. On the site, the target is
copied to ``files/`` and the link leads there.
"""

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
LINK = re.compile(r"(?<=\]\()([^)\s#]+)(?=[)#])")
FOLDER = "files"
SCRIPT = re.compile(r"python (benchmarks/\w+\.py)")
INLINE = re.compile(r"(?<!<pre>)(?<!</span>)<code>[^<]*</code>")
WORD = re.compile(r"(?<![^\s>])[^\s<>]+")
BLOCK = re.compile(r'<div class="language-(?:sh|text)\b.*?</div>', re.DOTALL)
OPTION = re.compile(r"(?<![^\s>])-[^\s<>]+")
LONGEST_WORD = 20
SETTING = re.compile(r"^- (command|date|versions): (.*)$", re.MULTILINE)
COMMIT = re.compile(r"\(([0-9a-f]{7,})")


def outside(link: str, page: str) -> str | None:
    """The path of a linked file in the repository, if it is not below ``docs/``; ``page`` is relative to ``docs/``."""
    if "://" in link or link.startswith("/"):
        return None
    path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page), link))
    return None if path.startswith("docs/") else path


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add every file that a page links to and that lies outside of ``docs/``, and those that such a file links to."""
    pages = [(file.src_uri, with_reports(file.content_string, file.src_uri)) for file in files.documentation_pages()]
    for page, text in pages:
        for link in LINK.findall(text):
            path = outside(link, page)
            if path and not files.get_file_from_path(f"{FOLDER}/{path}"):
                name = f"{FOLDER}/{path}"
                file = File.generated(config, name, abs_src_path=str(ROOT / path), inclusion=InclusionLevel.NOT_IN_NAV)
                files.append(file)
                if file.is_documentation_page():
                    pages.append((f"../{path}", file.content_string))
    return files


def reports(text: str) -> list[str]:
    """A row for each report of the scripts that a page of results names: command, date, commit."""
    scripts = set(SCRIPT.findall(text))
    rows = []
    for path in sorted((ROOT / "benchmarks" / "results").glob("*.md")):
        report = dict(SETTING.findall(path.read_text(encoding="utf-8")))
        found = SCRIPT.search(report.get("command", ""))
        if found and found[1] in scripts:
            commit = COMMIT.search(report["versions"])
            link = f"[{path.stem}](../../benchmarks/results/{path.stem}.md)"
            rows.append(f"| {link} | `{report['command']}` | {report['date']} | {commit[1] if commit else ''} |")
    return rows


def with_reports(text: str, page: str) -> str:
    """A page of results with its reports at the end."""
    rows = reports(text) if page.startswith("results/") else []
    head = ["", "## Reports", "", "| report | command | date | commit |", "|---|---|---|---|"]
    return "\n".join([text, *head, *rows, ""]) if rows else text


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001
    """Let links to such files lead to their place on the site."""

    def rewritten(match: re.Match[str]) -> str:
        path = outside(match[0], page.file.src_uri)
        return posixpath.relpath(f"{FOLDER}/{path}", posixpath.dirname(page.file.src_uri)) if path else match[0]

    if page.file.src_uri.startswith(f"{FOLDER}/"):
        return markdown  # as in the repository: its folders are below FOLDER
    return LINK.sub(rewritten, with_reports(markdown, page.file.src_uri))


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001
    """Let code in the text break where a reader expects it."""
    html = BLOCK.sub(lambda code: OPTION.sub(breakable, code[0]), html)
    return INLINE.sub(lambda code: WORD.sub(breakable, code[0].replace("\\|", "|")), html)


def breakable(word: re.Match[str]) -> str:
    """A word of code in HTML: left alone, a browser breaks ``--option`` behind its hyphens, and a long path nowhere."""
    if len(word[0]) > LONGEST_WORD and not word[0].startswith("-"):
        return re.sub(r"(?<!\d)[/_.|](?=\w\w)", r"\g<0><wbr>", word[0])
    return f'<span class="word">{word[0]}</span>' if "-" in word[0] else word[0]
