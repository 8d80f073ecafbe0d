"""Find words that this project does not use in prose; see "Language" in CONTRIBUTING.md.

    python -m tests.language             # exit code 1 and a list of places if a word is used
    python -m tests.language --update    # lower the counts that are allowed in the package to those of today
    python -m tests.language --places    # also list all places in the package

Documentation must not contain the words at all. Comments, docstrings and messages of the package contained them before
the check was introduced: `language_baseline.json` states how often, and the counts may only shrink.
"""

from __future__ import annotations

import argparse
import io
import json
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
BASELINE = Path(__file__).with_name("language_baseline.json")

WORDS = {
    "tell": (r"tells?|told|telling", "report, show, describe, warn"),
    "sound": (r"sound", "reliable, valid"),
    "law": (r"laws?", "contract, contract test, rule"),
    "gate": (r"gates?", "quality threshold"),
    "vote": (r"votes?|voted|voting", "fusion, support, agree"),
    "so many": (r"so (?:many|much)", "the number, or: this many, at most N"),
    "what there is": (r"what there (?:is|are|was|were)", "name the thing"),
    "but for": (r"but for", "except"),
    "come along": (r"(?:comes?|came|coming) along", "included, shipped"),
    "virtual range": (r"virtual ranges?", "depth hypothesis"),
    "is none": (r"(?<!there\s)(?:is|are) (?-i:none)", "there is no …, returns None"),
    "is no": (
        r"(?<!there\s)(?:is|are) no (?!longer|more|other|less|larger|smaller|better|worse|fewer|wider)[a-z]+",
        "is not a …",
    ),
    "of ours": (r"of ours", "in pano_mvs, our"),
    "of one name": (r"of one name", "with the same name"),
    "anew": (r"anew", "again"),
}
"""Name of a word, the expression that finds it, and what to write instead."""

ALLOWED = (
    r"laws? of (?:co)?sines",
    r"told apart",
    r"tells? (?:them|these|both|the two) apart",
    r"but for (?:each|every|all|any|one|two|a|an|the) \w+ (?:it|they|there)",  # "but" as a conjunction
)
"""Legitimate uses, as expressions."""

_ALLOWED = re.compile("|".join(ALLOWED), re.IGNORECASE)
_PATTERNS = {
    name: re.compile(rf"\b(?:{pattern.replace(' ', chr(92) + 's+')})\b", re.IGNORECASE)
    for name, (pattern, _) in WORDS.items()
}
_ANY = re.compile(
    rf"\b(?:{'|'.join(pattern.replace(' ', '[ #' + chr(92) + 'n]+') for pattern, _ in WORDS.values())})\b",
    re.IGNORECASE,
)
_FENCE = re.compile(r"^( *)(```|~~~).*?^ *\2 *$", re.DOTALL | re.MULTILINE)
_NOT_PROSE = re.compile(r"<!--.*?-->|\$\$.*?\$\$|``.*?``|`[^`]*`|\]\([^)]*\)", re.DOTALL)
_ENTRY = re.compile(r"^ +\w+: ", re.MULTILINE)
"""Name of a parameter or an attribute in a docstring, which is not prose."""
_STRING = re.compile(r"^[a-zA-Z]*('''|\"\"\"|'|\")(.*)\1$", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Place:
    """A use of a word.

    Attributes:
        word: name of the word, a key of `WORDS`.
        path: file, relative to the root of the repository.
        line: line number, from 1.
        text: the words as they are written.
    """

    word: str
    path: str
    line: int
    text: str

    def __str__(self) -> str:
        """Return the place in the form of a compiler message."""
        return f"{self.path}:{self.line}: {self.text!r}; write: {WORDS[self.word][1]}"


def documents() -> list[Path]:
    """Return all documents in which no word may be used."""
    found = [*ROOT.glob("docs/**/*.md"), *ROOT.glob("plugins/**/*.md"), *ROOT.glob("workflows/**/*.yaml")]
    return sorted([*found, *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"))])


def modules() -> list[Path]:
    """Return all modules of the package, and the templates of the report."""
    return sorted([*ROOT.glob("pano_mvs/**/*.py"), *ROOT.glob("pano_mvs/**/*.j2")])


def places_in_document(path: Path) -> list[Place]:
    """Return the places in a Markdown or YAML file; of YAML, only comments count."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".yaml":
        return list(_places(re.sub(r"^[^#\n]*", "", text, flags=re.MULTILINE), path, 1))
    return list(_places(_blank(_NOT_PROSE, _blank(_FENCE, text)), path, 1))


def places_in_module(path: Path) -> list[Place]:
    """Return the places in comments, docstrings and other strings of a Python file, or in a template."""
    if path.suffix != ".py":
        return places_in_document(path)
    source = path.read_text(encoding="utf-8")
    if not _ANY.search(source):  # which saves the time to tokenize most files
        return []
    return [place for text, line in prose_of(source) for place in _places(text, path, line)]


def prose_of(source: str) -> Iterator[tuple[str, int]]:
    """Yield comments and strings of a Python source with the line on which each begins.

    Consecutive lines of comments are joined. Code in backticks, braces of f-strings, names of parameters in
    docstrings, and strings without a space (keys and names) are left out.
    """
    comment: list[str] = []
    began = last = 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            if comment and token.start[0] != last + 1:
                yield "\n".join(comment), began
                comment = []
            if not comment:
                began = token.start[0]
            comment.append(_blank(_NOT_PROSE, token.string.lstrip("#")))
            last = token.start[0]
        elif token.type == tokenize.STRING or tokenize.tok_name[token.type] == "FSTRING_MIDDLE":
            found = _STRING.match(token.string)
            text = re.sub(r"\{[^{}]*\}", " _ ", _blank(_ENTRY, _blank(_NOT_PROSE, found[2] if found else token.string)))
            if " " in text.strip():
                yield text, token.start[0]
    if comment:
        yield "\n".join(comment), began


def grown(counts: Counter[str], allowed: dict[str, int]) -> list[str]:
    """Return the words that are used more often than allowed."""
    return [word for word in WORDS if counts[word] > allowed.get(word, 0)]


def count(places: Iterable[Place]) -> Counter[str]:
    """Return how often each word is used."""
    return Counter(place.word for place in places)


def allowed_counts() -> dict[str, int]:
    """Return how often each word may be used in the package."""
    counts: dict[str, int] = json.loads(BASELINE.read_text(encoding="utf-8"))
    return counts


def _blank(pattern: re.Pattern[str], text: str) -> str:
    """Return a text without what a pattern finds, but with its lines."""
    return pattern.sub(lambda found: "_" + "\n" * found[0].count("\n"), text)


def _places(text: str, path: Path, line: int) -> Iterator[Place]:
    text = _blank(_ALLOWED, text)
    for word, pattern in _PATTERNS.items():
        for found in pattern.finditer(text):
            number = line + text.count("\n", 0, found.start())
            yield Place(word, path.relative_to(ROOT).as_posix(), number, " ".join(found[0].split()))


def main(arguments: list[str] | None = None) -> int:
    """Check documents and package; return 1 if a word is used that may not be."""
    parser = argparse.ArgumentParser(description="Find words that this project does not use in prose.")
    parser.add_argument("--update", action="store_true", help="lower the counts that are allowed in the package")
    parser.add_argument("--places", action="store_true", help="list all places in the package")
    options = parser.parse_args(arguments)
    in_documents = [place for path in documents() for place in places_in_document(path)]
    in_package = [place for path in modules() for place in places_in_module(path)]
    counts, allowed = count(in_package), allowed_counts()
    too_many = grown(counts, allowed)
    shown = in_documents + [place for place in in_package if options.places or place.word in too_many]
    for place in shown:
        print(place)
    for word in too_many:
        print(f"pano_mvs: {word!r} is used {counts[word]} times, {allowed.get(word, 0)} are allowed")
    if options.update:
        lowered = {word: min(counts[word], allowed.get(word, 0)) for word in WORDS}
        BASELINE.write_text(json.dumps(lowered, indent=1) + "\n", encoding="utf-8")
    return int(bool(in_documents or too_many))


if __name__ == "__main__":
    sys.exit(main())
