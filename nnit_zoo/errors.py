"""The one exception for mistakes that a user can mend; the command lines print it without a traceback."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class UserError(Exception):
    """Something the user gave or lacks; the message says what to do about it."""


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UserError:
    """The error for a name that is not among the known ones, with the nearest of them."""
    names = sorted(known)
    near = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    if near:
        advice = f"did you mean {' or '.join(near)}?"
    elif len(names) <= 12:
        advice = f"there are {', '.join(names) or 'none'}"
    else:
        advice = f"there are {len(names)}, such as {', '.join(names[:5])}"
    return UserError(f"no {kind} named '{name}': {advice}")
