"""What the functions of a source are handed: of all the scratch and context there is, what some line of it names.

To machine code an array is seven arguments. Two dozen that nobody reads are a fifth of the time that a small scene
takes to compile, and are unpacked at every call.
"""

from __future__ import annotations

import re

from flockenv.sweep.text import CONTEXT, SHARED

__all__ = ["trimmed"]

_NAMES = CONTEXT.split(", ")
_UNPACKED = re.compile(re.escape(CONTEXT) + r" = (.+)")


def trimmed(source: str) -> str:
    """Return a source that was written as if all were handed to everybody, with what is named alone.

    A function that opens its context takes out of it what it names; the context, and the scratch, are what all of them
    do. `SCRATCH` says, to whoever calls an entry point, which scratch that is, in order.
    """
    functions = re.split(r"(?=^@)", source, flags=re.MULTILINE)
    named = [_words(text) if _UNPACKED.search(text) else set() for text in functions]
    context = [name for name in _NAMES if any(name in words for words in named)]

    def opened(text: str, words: set[str]) -> str:
        mine = [(name, place) for place, name in enumerate(context) if name in words]
        return _UNPACKED.sub(lambda m: "; ".join(f"{name} = {m[1]}[{place}]" for name, place in mine), text)

    text = "".join(map(opened, functions, named)).replace(f"({CONTEXT})", f"({', '.join(context)},)")
    words = _words(text)
    scratch = ", ".join(name for name in SHARED.split(", ") if name in words)
    return text.replace(SHARED, scratch) + f'\n\nSCRATCH = "{scratch}"\n'


def _words(text: str) -> set[str]:
    """Return all words of a text's code but those of the lists themselves; a comment needs no array."""
    code = re.sub(r"#.*", "", text.replace(CONTEXT, "").replace(SHARED, ""))
    return set(re.findall(r"\w+", code))
