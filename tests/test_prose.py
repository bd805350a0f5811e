"""README.md, docs/, docstrings and comments keep the budget of tools/prose_budget.json, which may only fall."""

import json

import pytest

from tools import prose


def test_the_pages_keep_the_budget():
    budget = json.loads(prose.BUDGET.read_text(encoding="utf-8"))
    found = prose.counts()
    over = {kind: (found[kind], allowed) for kind, allowed in budget.items() if found[kind] > allowed}
    assert over == {}, "correct what `python tools/prose.py` prints"
    assert set(found) <= set(budget)


PAGE = "# Page\n\nAfter this page you know it.\n\n"


@pytest.mark.parametrize(
    ("text", "kinds"),
    [
        ("The robot sends a packet.", []),
        ("The robot sends " + "word " * 31 + "now.", ["long sentences"]),
        ("Two floors may look alike.", ["words"]),
        ("`no two of their places look alike`", []),
        ("What the cloud receives is checked.", ["clauses as subjects"]),
        ("What is a place? It is a set of keypoints.", []),
        ("A is sent. B is then drawn. C is never kept.", ["passive chains"]),
        ("A is sent. The robot waits. C is kept. D was cut.", []),
        ("Go.\n\n| a | b |\n" + "| word | word |\n" * 400, ["long pages"]),
        ("    What is code is no prose.\n\n```sh\nWhat is a comment.\n```", []),
    ],
)
def test_the_rules(text, kinds):
    assert [kind for kind, _ in prose.findings(PAGE + text)] == kinds


def test_a_page_begins_with_the_reader():
    assert [kind for kind, _ in prose.findings("# Page\n\nIt is a page.\n")] == [
        "pages that do not begin with the reader"
    ]


@pytest.mark.parametrize(
    ("source", "kinds"),
    [
        ('"""The robot sends a packet."""\n', []),
        ('x = 1\n"""What the robot sends."""\n', ["clauses as subjects in code"]),
        ("# Two floors\n# look alike.\n", ["words in code"]),
        ('def f():\n    """Send ' + "word " * 32 + 'now."""\n', ["long sentences in code"]),
        (
            'def f():\n    """Send.\n\n    Args:\n        a: '
            + "word " * 20
            + "\n        b: "
            + "word " * 20
            + '\n    """\n',
            [],
        ),
        ('"""A format:\n\n    What ' + "word " * 40 + '\n\nThe end.\n"""\n', []),
        ("x = 1  # What it is.\ny = 2  # It is two.\n", ["clauses as subjects in code"]),
        ('text = "What it says."\n', []),
    ],
)
def test_the_rules_for_code(source, kinds):
    assert [kind for kind, _ in prose.findings_in_code(source)] == kinds
