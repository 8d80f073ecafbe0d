"""Which changes of a definition change its digest."""

from __future__ import annotations

import pytest

from pano_mvs.engine.code.reach import CodeGraph

STAGE = "from pano_mvs.api import stage, source\n"
FIELD = "class f:\n    x: int = Field(1, description='a', title='b', examples=[1], ge=0)\n"


def digest(text: str) -> str:
    return CodeGraph({}, texts={"m": (text, False)}).reach_of(["m:f"]).definitions["m:f"]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("def f():\n    '''Doc.'''\n    return 1", "def f():\n    return 1"),
        ("def f():\n    x = 1\n    'a note'\n    return x", "def f():\n    x = 1\n    return x"),
        ("def f():\n    if x:\n        pass\n        y()", "def f():\n    if x:\n        y()"),
        ("def f():\n    if x:\n        y()\n    else:\n        pass", "def f():\n    if x:\n        y()"),
        (
            "def f():\n    try:\n        y()\n    finally:\n        'a'\n        z()",
            "def f():\n    try:\n        y()\n    finally:\n        z()",
        ),
        ("def f(a: int, *b: int, c: int = 1, **d: int) -> int: ...", "def f(a, *b, c=1, **d): ..."),
        ("async def f(a: int) -> int: ...", "async def f(a): ..."),
        ("def f():\n    x: int\n    x = 1", "def f():\n    x = 1"),
        ("def f():\n    x: int = 1", "def f():\n    x = 1"),
        ("f: int = 1", "f = 1"),
        ("def f():\n    return (1 +\n        2)  # three", "def f(): return 1 + 2"),
        ("def f(): return 'a'", 'def f(): return "a"'),
        ("def f(): return u'a'", "def f(): return 'a'"),
        ("def f(): return f'a{x}b'", "def f(): return 'a' f'{x}b'"),
        ("def f(): return f'{x}' 'ab'", "def f(): return f'{x}' 'a' 'b'"),
        ("def f(): return f'{x}' ''", "def f(): return f'{x}'"),
        (FIELD, FIELD.replace("description='a', ", "")),
        (FIELD, FIELD.replace("title='b'", "title='c'")),
        (FIELD, FIELD.replace("examples=[1]", "examples=[2]")),
        (FIELD.replace("Field", "pydantic.Field"), FIELD.replace("Field", "pydantic.Field").replace("'a'", "'b'")),
        (STAGE + "@stage('a')\ndef f(): ...", STAGE + "@stage('b', memory='2GB')\ndef f(): ..."),
        (STAGE + "@source('a')\ndef f(): ...", STAGE + "def f(): ..."),
        ("import pano_mvs.engine.stages.stage as s\n@s.stage('a')\ndef f(): ...", "def f(): ..."),
        ("from pano_mvs import api\n@api.stage('a')\nasync def f(): ...", "async def f(): ..."),
    ],
)
def test_what_changes_no_result_changes_no_digest(first: str, second: str) -> None:
    assert digest(first) == digest(second)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("f = 1", "f = 1.0"),
        ("f = 1", "f = True"),
        ("f = 'a'", "f = b'a'"),
        ("f = 'None'", "f = None"),
        ("f = [1, 2]", "f = [12]"),
        ("f = [1, 2]", "f = [2, 1]"),
        ("f = [1, 2]", "f = (1, 2)"),
        ("f = [[1], 2]", "f = [[1, 2]]"),
        ("f = a + b", "f = a - b"),
        ("f = a[1:]", "f = a[:1]"),
        ("f = g(a=b)", "f = g(b=b)"),
        ("f = g(a)", "f = g(*a)"),
        ("f = 1", "f = 1\nf = 2"),
        ("f = 1\nf = 2", "f = 2\nf = 1"),
        ("f = 1", "f = 1\nf += 1"),
        ("f = f'{x}'", "f = f'{x!r}'"),
        ("f = f'{x:3}'", "f = f'{x:4}'"),
        ("f = f'{x}{y}'", "f = f'{y}{x}'"),
        ("f = f'a{x}'", "f = f'{x}a'"),
        ("f = f'{x}'", "f = f'{x} '"),
        ("def f(): a()", "async def f(): a()"),
        ("def f(a): ...", "def f(*, a): ..."),
        ("def f(a, b): ...", "def f(b, a): ..."),
        ("def f(a=1): ...", "def f(a=2): ..."),
        ("def f(): return 1", "def f(): 1"),
        ("def f():\n    if x:\n        y()", "def f():\n    y()"),
        ("def f():\n    if x:\n        y()\n        z()", "def f():\n    if x:\n        y()\n    z()"),
        ("def f():\n    x = 'a'", "def f():\n    'a'"),
        ("class f:\n    x: int = 1", "class f:\n    x: float = 1"),
        ("class f:\n    x: int", "class f: ..."),
        (FIELD, FIELD.replace("ge=0", "ge=1")),
        (FIELD, FIELD.replace("Field(1", "Field(2")),
        (FIELD.replace("Field", "Other"), FIELD.replace("Field", "Other").replace("'a'", "'b'")),
        ("@g\ndef f(): ...", "def f(): ..."),
        ("@stage('a')\ndef f(): ...", "@stage('b')\ndef f(): ..."),  # not ours
        ("from other import stage\n@stage('a')\ndef f(): ...", "def f(): ..."),
        (STAGE + "@stage('a')\n@g\ndef f(): ...", STAGE + "@stage('a')\ndef f(): ..."),
    ],
)
def test_what_may_change_a_result_changes_the_digest(first: str, second: str) -> None:
    assert digest(first) != digest(second)
